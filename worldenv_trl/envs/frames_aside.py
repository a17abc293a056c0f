"""Keeps the frames of a wave out of its TensorDict."""

from __future__ import annotations

import os
import tempfile

from tensordict import LazyStackedTensorDict, TensorDictBase
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from worldenv_trl.keys import FRAMES
from worldenv_trl.memmap import check_room, release

__all__ = ["FramesAside"]


class FramesAside(Transform):
    """Takes ``frames`` out of what a decision-level env writes; on request they go to a file instead.

    A rollout carries every entry of the env twice, as ``next`` and as the root of the step after, and LOOP reads none
    of the frames between decisions: at 128 px, two cameras and 192 rows they would be nearly 3 GB a wave. Goes around
    the transforms that read frames (:class:`~worldenv_trl.envs.Reflect`).

    :attr:`keep` may be set before a wave begins; then :meth:`frames` gives them afterwards.

    Args:
        folder: where the files go, until the wave after or the end of the program; None is the system's folder for
            temporary files, which may be in memory.

    Raises:
        OSError: from a step, if the disk has no room for its frames.

    Examples:
        >>> aside = FramesAside()
        >>> aside.keep = True
    """

    def __init__(self, folder: str | os.PathLike | None = None) -> None:
        super().__init__()
        self.keep = False
        self._where = folder
        self._folder: tempfile.TemporaryDirectory | None = None
        self._decisions: list[TensorDictBase] = []

    def frames(self) -> TensorDictBase:
        """``("frames", entry)`` uint8 [*B, D, C, 3, H, W] of the D decisions since the reset, from their files: what is
        indexed is read.

        Raises:
            RuntimeError: if :attr:`keep` was not set when they were made.
        """
        if not self._decisions:
            raise RuntimeError("no frames were kept: set keep to True before the env is reset")
        return LazyStackedTensorDict.lazy_stack(self._decisions, self._decisions[0].ndim)

    def release(self) -> None:
        """Gives back the memory that shows the files."""
        for decision in self._decisions:
            release(decision)

    def _reset(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or bool(mask.all()):
            self._decisions = []
            if self._folder is not None:
                self._folder.cleanup()
            self._folder = tempfile.TemporaryDirectory(dir=self._where) if self.keep else None
        return tensordict_reset.exclude(FRAMES)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._folder is not None:
            shown = next_tensordict.select(FRAMES).cpu()
            check_room(self._folder.name, shown.bytes(), "the frames of a decision")
            self._decisions.append(shown.memmap(f"{self._folder.name}/{len(self._decisions)}"))
            release(self._decisions[-1])
        return next_tensordict.exclude(FRAMES)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        del observation_spec[FRAMES]
        return observation_spec
