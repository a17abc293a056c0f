"""A training window: some frames of an episode under their numbers, and the steps to learn."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.keys import FRAMES
from worldenv_trl.world_models.base import POSES

__all__ = ["Window"]


class Window:
    """Windows [B] of B episodes: n C steps from a frame on, and the frames that a world model remembers on the way.

    Reads ``("frames", entry)`` uint8 [B, K, 3, H, W] of each camera, ``poses`` [B, K, 13] and their numbers in the
    episode, ``number`` int64 [B, K]; ``start`` int64 [B, 1], the frame after which the window begins; ``actions``
    [B, n C, 7] and ``step_mask`` bool [B, n C] (False past the end of the episode, where the last frame repeats).
    """

    def __init__(self, windows: TensorDictBase) -> None:
        self._frames = windows.select(FRAMES, POSES)
        self._numbers = windows["number"]
        self.start, self.actions = windows["start"].squeeze(-1), windows["actions"]
        self.mask = windows["step_mask"]

    @property
    def steps(self) -> int:
        """n C."""
        return self.actions.shape[1]

    def recall(self, numbers: Tensor) -> TensorDict:
        """Frames and poses [B, K] by their numbers int64 [B, K]; what is not in the window is an error of the sampler.

        Raises:
            ValueError: for a number that the window does not hold.
        """
        rows = torch.arange(len(numbers), device=numbers.device).unsqueeze(-1)
        place = self._places(numbers)
        out = TensorDict(batch_size=numbers.shape, device=numbers.device)
        for key in self._frames.keys(True, True):
            out[key] = self._frames[key][rows, place]
        return out

    def with_own(self, own: Tensor, numbers: Tensor, frames: Mapping[tuple[str, str], Tensor], shown: Window) -> Window:
        """``shown`` with the given frames under their numbers [B, C] in the rows ``own``; the other rows real again."""
        rows = torch.arange(len(numbers), device=numbers.device).unsqueeze(-1)
        place = self._places(numbers)
        out = Window.__new__(Window)
        out.__dict__ = dict(self.__dict__)
        out._frames = self._frames.clone(False)
        for key, painted in frames.items():
            keep = own.view(-1, *[1] * (painted.ndim - 1))
            values = torch.where(keep, shown._frames[key], self._frames[key])
            values[rows, place] = torch.where(keep, painted, self._frames[key][rows, place])
            out._frames[key] = values
        return out

    def _places(self, numbers: Tensor) -> Tensor:
        """Where the numbers [B, K] are: the last place that holds each."""
        same = numbers.unsqueeze(-1) == self._numbers.unsqueeze(1)  # [B, K, held]
        if not bool(same.any(-1).all()):
            row, place = (int(index) for index in (~same.any(-1)).nonzero()[0])
            raise ValueError(f"frame {int(numbers[row, place])} is not in window {row}")
        return same.long().cumsum(-1).argmax(-1)
