"""What a task is: a scene, an instruction, a goal, and where it starts."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from worldenv_trl.context_ids import MOST_STATES, SPLITS
from worldenv_trl.robot import WRIST, Camera
from worldenv_trl.scenes.arena import AGENTVIEW
from worldenv_trl.scenes.canvas import Glow

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

__all__ = ["Task"]


@dataclass(frozen=True)
class Task(abc.ABC):
    """A task: a scene, an instruction and a goal.

    ``goal`` is a conjunction of ``(predicate, argument, ...)``. What a task is, is said by its ``name``, and which
    version of it by its ``digest``, a hexadecimal hash of what describes it; numbers are given by whoever runs it.
    ``cameras`` are those of its scene that are described to others, see :meth:`camera`.
    """

    name: str
    suite: str
    language: str
    goal: tuple[tuple[str, ...], ...]
    digest: str
    max_steps: int = 64
    cameras: tuple[Camera, ...] = (AGENTVIEW, WRIST)

    @abc.abstractmethod
    def build(self) -> mujoco.MjModel:
        """Compiles the scene; cached, so treat the model as read-only."""

    @abc.abstractmethod
    def evaluate(self, scene: SceneBatch) -> np.ndarray:
        """``[n]`` bool: every predicate of the goal holds in the current state."""

    @abc.abstractmethod
    def glows(self, model: mujoco.MjModel) -> Sequence[Glow]:
        """Colours that show the state: a burner glows while its stove is on."""

    @abc.abstractmethod
    def init_states(self, split: str, count: int = 50) -> np.ndarray:
        """Initial states ``[count, S]`` float64: settled, free of collisions, fixed by seed.

        ``train`` and ``test`` are disjoint; a larger count extends a smaller one. Those stored beside a task file are
        all solved by the scripted expert; states beyond them are drawn untried.

        Raises:
            ValueError: for an unknown split or a count that is not from 1 to 50,000.
            RuntimeError: if things cannot be placed without overlap, naming the last one tried.
        """

    def camera(self, name: str) -> Camera:
        """Raises ``ValueError`` for a camera the task does not have."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise ValueError(f"unknown camera {name!r}: {self.name} has {', '.join(c.name for c in self.cameras)}")

    def _check_split(self, split: str, count: int) -> None:
        if split not in SPLITS:
            raise ValueError(f"unknown split {split!r}: it must be 'train' or 'test'")
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        if count > MOST_STATES:
            raise ValueError(f"count must be at most {MOST_STATES}, got {count}: no more initial states are numbered")
