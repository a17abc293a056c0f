"""A reflector that is nothing like the compact one: no training, no memory, no features. It looks for a colour."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict

from worldenv_trl.pretrained import Pretrained
from worldenv_trl.reflectors import Reflector


@dataclass(frozen=True)
class ColourConfig:
    """R is 0.5 where ``share`` of the last frame's pixels are redder than green and blue by ``margin`` of 255."""

    cameras: tuple[str, ...] = ("agentview",)
    share: float = 0.1
    margin: int = 60


class ColourReflector(Reflector, Pretrained):
    """The share of reddish pixels of the last frame, over all cameras, as a probability."""

    config_class = ColourConfig

    def __init__(self, config: ColourConfig = ColourConfig()) -> None:
        super().__init__(cameras=config.cameras)
        self.config = config

    def begin(self, frames, instructions):
        score = self._score(frames)
        return TensorDict({"score": score}, batch_size=[len(score)])

    def extend(self, state, frames):
        scores = self._score(frames)  # [n, C]
        return TensorDict({"score": scores[:, -1]}, batch_size=[len(scores)]), scores

    def _score(self, frames):
        red, green, blue = torch.cat([frames[camera] for camera in self.cameras], -1).int().unbind(-3)
        reddish = (red - torch.maximum(green, blue) > self.config.margin).float().mean((-2, -1))
        return reddish / (reddish + self.config.share)
