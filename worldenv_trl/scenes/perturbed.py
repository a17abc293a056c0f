"""The expert, disturbed on purpose: near misses for a reflector to learn from."""

from __future__ import annotations

import math
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.keys import ACTION_DIM
from worldenv_trl.scenes.expert import ScriptedExpert
from worldenv_trl.scenes.skills import OPEN

if TYPE_CHECKING:
    from worldenv_trl.scenes.files import FileTask
    from worldenv_trl.scenes.simulation import SceneBatch
    from worldenv_trl.scenes.tasks import Task

__all__ = ["PerturbedExpert"]

_FLIPPED = 3  # steps that a flip of the gripper lasts
_UNTIL_RELEASE = 22  # an early release comes at most this many steps after the thing was lifted
_RISING = 4  # steps that the hand rises after it


class PerturbedExpert:
    """A :class:`ScriptedExpert` that goes wrong; ``expert(scene)`` gives actions ``[n, 7]`` in [-1, 1].

    Each row draws its own mishaps when it is reset, from ``(seed, row, number of the episode)`` alone.

    Args:
        task: a task of a file, or its name or path.

    Keyword Args:
        noise: standard deviation of what is added to every action.
        gripper_flips: probability of a step that the gripper does the opposite for three steps.
        early_release: probability of an episode in which the hand opens while it carries, and gives up.
        wrong_object: probability of an episode in which another thing is put where the goal asks for its own.
        seed: of all of these.

    Raises:
        ValueError: for a probability out of [0, 1], a noise that is negative or not finite, a seed below 0, or
            ``wrong_object`` where nothing else can be gripped and put there.
    """

    def __init__(
        self,
        task: Task | str | Path,
        *,
        noise: float = 0.0,
        gripper_flips: float = 0.0,
        early_release: float = 0.0,
        wrong_object: float = 0.0,
        seed: int = 0,
    ) -> None:
        chances = {"gripper_flips": gripper_flips, "early_release": early_release, "wrong_object": wrong_object}
        for name, value in chances.items():
            if not _is_number(value) or not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} is a probability, got {value!r}: pass a number from 0 to 1")
        if not _is_number(noise) or not 0.0 <= noise < math.inf:
            raise ValueError(f"noise must be a finite number and not negative, got {noise!r}")
        if not _is_number(seed, Integral) or isinstance(seed, bool) or seed < 0:
            raise ValueError(f"seed must be a whole number of at least 0, got {seed!r}")
        self.noise, self.gripper_flips, self.early_release = noise, gripper_flips, early_release
        self.wrong_object, self.seed = wrong_object, seed
        self._right = ScriptedExpert(task, warn=False)
        self._wrong = ScriptedExpert(task, goal=_wrong_goal(self._right.task), warn=False) if wrong_object else None
        self._rngs: list[np.random.Generator] = []

    def reset(self, rows: np.ndarray | None = None) -> None:
        """Starts ``rows`` (default: all) anew, with other mishaps."""
        for expert in (self._right, self._wrong):
            if expert is not None:
                expert.reset(rows)
        for row in range(len(self._rngs)) if rows is None else rows:
            if self._rngs:
                self._begin(int(row))

    def _begin(self, row: int) -> None:
        self._episode[row] += 1
        self._rngs[row] = rng = np.random.default_rng([self.seed, row, self._episode[row]])
        self._is_wrong[row] = rng.random() < self.wrong_object
        lets_go = rng.random() < self.early_release
        self._release_in[row] = rng.integers(4, _UNTIL_RELEASE + 1) if lets_go else -1
        self._released[row], self._flipped[row] = 0, 0

    def __call__(self, scene: SceneBatch) -> np.ndarray:
        n = scene.num_envs
        if len(self._rngs) != n:
            self._rngs = [np.random.default_rng(0)] * n
            self._episode, self._release_in = np.full(n, -1), np.full(n, -1)
            self._released, self._flipped = np.zeros(n, int), np.zeros(n, int)
            self._is_wrong = np.zeros(n, bool)
            for row in range(n):
                self._begin(row)
        action = self._right(scene)
        carrying = self._right.carrying.copy()
        if self._wrong is not None:
            other = self._wrong(scene)
            action[self._is_wrong], carrying[self._is_wrong] = (
                other[self._is_wrong],
                self._wrong.carrying[self._is_wrong],
            )
        for row, rng in enumerate(self._rngs):
            self._disturb(action[row], row, bool(carrying[row]), rng)
        return np.clip(action, -1.0, 1.0)

    def _disturb(self, action: np.ndarray, row: int, carrying: bool, rng: np.random.Generator) -> None:
        """Changes one row's ``action [7]`` in place."""
        if self._released[row] == 0 and carrying and self._release_in[row] > 0:
            self._release_in[row] -= 1
            self._released[row] = int(self._release_in[row] == 0)
        if self._released[row]:
            action[:] = 0.0
            action[2] = 0.4 if _RISING < self._released[row] <= 2 * _RISING else 0.0  # up, once the fingers are open
            action[6] = OPEN
            self._released[row] += 1
        elif self._flipped[row] or rng.random() < self.gripper_flips:
            self._flipped[row] = (self._flipped[row] + 1) % _FLIPPED
            action[6] = -action[6]
        action[:6] += self.noise * rng.standard_normal(ACTION_DIM - 1)


def _is_number(value: object, kind: type = Real) -> bool:
    return isinstance(value, kind)


def _wrong_goal(task: FileTask) -> list[tuple[str, ...]]:
    """The goal with another thing in the place of the first that is to be moved."""
    asked = {aim[1] for aim in task.goal if aim[0] in ("On", "In")} | {aim[2] for aim in task.goal if len(aim) > 2}
    others = [name for name, entity in task.entities.items() if entity.grasp is not None and name not in asked]
    for index, aim in enumerate(task.goal):
        if aim[0] in ("On", "In") and others:
            return [*task.goal[:index], (aim[0], others[0], *aim[2:]), *task.goal[index + 1 :]]
    raise ValueError(f"{task.name} has nothing that could be put in the wrong thing's place: wrong_object must be 0")
