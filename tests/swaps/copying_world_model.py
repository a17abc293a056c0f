"""A world model that is nothing like the compact one: untrained, it believes that nothing ever moves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase

from worldenv_trl.keys import frames_key
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.world_models import WorldModel, memory_key


@dataclass(frozen=True)
class CopyingConfig:
    """What it paints; it remembers the last frame and the one ``stride`` back."""

    cameras: tuple[str, ...] = ("agentview",)
    image_size: int = 64
    chunk_length: int = 8
    stride: int = 4


class CopyingWorldModel(WorldModel, Pretrained):
    """Every frame of the chunk is the last one remembered."""

    config_class = CopyingConfig

    def __init__(self, config: CopyingConfig = CopyingConfig()) -> None:
        super().__init__(cameras=config.cameras, image_size=config.image_size, chunk_length=config.chunk_length)
        self.config = config

    def memory_indices(self, now: torch.Tensor) -> torch.Tensor:
        return torch.stack([(now - self.config.stride).clamp(min=0), now], -1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        for camera in self.cameras:
            last = tensordict[memory_key(camera)][:, -1:]
            tensordict[frames_key(camera)] = last.expand(-1, self.chunk_length, -1, -1, -1).clone()
        return tensordict
