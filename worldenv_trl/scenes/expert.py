"""A scripted expert with privileged state, composed of skills, batched over rows.

Each step it looks at the true state again, so actions disturbed from outside are corrected as far as they can be.
"""

from __future__ import annotations

import warnings
from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.keys import ACTION_DIM, POSITION_STEP, ROTATION_STEP
from worldenv_trl.robot import panda
from worldenv_trl.scenes import controller
from worldenv_trl.scenes.catalogue import load_task
from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.plan import plan_stages
from worldenv_trl.scenes.reach import out_of_reach
from worldenv_trl.scenes.settings import setting_of
from worldenv_trl.scenes.skills.phase import wrist_yaw
from worldenv_trl.scenes.tasks import Task

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

_DOWN = np.diag([1.0, -1.0, -1.0])  # the hand points straight down, fingers open along y
_PATIENCE = 12  # steps after the last phase until what does not hold is done again
_RAMP, _BRAKE = 0.08, 0.25  # of a gentle phase: the speed's growth a step; the share of the way that a step may take
_TURNED = 0.12  # rad; a phase that turns the hand ends within this


class ScriptedExpert:
    """Solves one task; ``expert(scene)`` gives normalised actions ``[n, 7]``.

    Args:
        task: a task of a file, or its name or path.

    Keyword Args:
        goal: what to do instead of the task's goal, in the same form.
        warn: say, once for each predicate of the goal, that it fails because something lies out of the arm's reach.

    Raises:
        TypeError: for what is no task, or no list of predicates.
        ValueError: for a goal that its skills cannot reach or that names what is not there, and a task that no file
            describes.
    """

    def __init__(
        self, task: Task | str | Path, *, goal: Sequence[tuple[str, ...]] | None = None, warn: bool = True
    ) -> None:
        task = task if isinstance(task, Task) else load_task(task)
        if not isinstance(task, FileTask):
            raise ValueError(
                f"no script for {task.name}: the expert plans from a task file (load_task), not from a class"
            )
        self.task, self._relations = task, task.relations
        self._stages = plan_stages(task, task.goal if goal is None else goal)
        self._ends = list(accumulate(len(stage.phases) for stage in self._stages))
        self.phases = [phase for stage in self._stages for phase in stage.phases]
        self.phase: np.ndarray | None = None
        self._warn = warn
        self._said: set[int] = set()  # stages that were said to be out of reach

    def reset(self, rows: np.ndarray | None = None) -> None:
        """Starts ``rows`` (default: all) from the first phase."""
        if rows is None:
            self.phase = None
        elif self.phase is not None:
            self.phase[rows], self._dwell[rows], self._spent[rows], self._memory[rows] = 0, 0, 0, np.nan
            self._yaw[rows], self._missed[rows], self._failed[rows] = 0.0, np.nan, False

    def __call__(self, scene: SceneBatch) -> np.ndarray:
        """Actions ``[n, 7]`` in [-1, 1] for the current state of every row."""
        n = scene.num_envs
        if self.phase is None or len(self.phase) != n:
            self.phase, self._dwell, self._spent = (np.zeros(n, int) for _ in range(3))
            self._memory, self._yaw = np.full((n, 3), np.nan), np.zeros(n)
            self._missed, self._failed = np.full((n, len(self._stages), 3), np.nan), np.zeros(n, bool)
        position = scene.measured_state()[:, :3].astype(float)
        targets = scene.batch.bind("userdata")
        commanded = targets[:, 3:12].reshape(-1, 3, 3)
        action, following = np.zeros((n, ACTION_DIM)), self.phase.copy()
        for index in np.unique(self.phase):
            phase, rows = self.phases[index], self.phase == index
            if phase.remember is not None:
                fresh = rows & np.isnan(self._memory[:, 0])
                if fresh.any():
                    self._memory[fresh] = phase.remember(scene)[fresh]
            if phase.yaw is not None:
                self._yaw[rows] = wrist_yaw(phase.yaw(scene), self._yaw)[rows]
            goal = phase.target(scene, self._memory)
            # Where it cannot get to, it goes as near as it can, and on: nothing that is seen would tell when to go on.
            nearest = np.clip(goal, panda.WORKSPACE_LOW, panda.WORKSPACE_HIGH)
            error = nearest - targets[:, :3]
            if phase.yaw is not None:  # no lower before the hand is turned: the palm is broad
                turning = np.linalg.norm(self._turn(commanded), axis=-1) > _TURNED
                error[turning, 2] = np.maximum(error[turning, 2], 0.0)
            length = np.linalg.norm(error, axis=-1, keepdims=True)
            fastest = np.full((n, 1), phase.speed * POSITION_STEP)
            if phase.gentle:
                ramp = POSITION_STEP * _RAMP * (1 + self._spent[:, None])
                fastest = np.minimum(np.minimum(fastest, ramp), np.maximum(_BRAKE * length, POSITION_STEP * _RAMP))
            step = error / POSITION_STEP * np.minimum(1.0, fastest / np.maximum(length, 1e-9))
            action[rows, :3], action[rows, 6] = step[rows], phase.gripper
            arrived = rows & (np.linalg.norm(nearest - position, axis=-1) < phase.tolerance)
            if phase.yaw is not None:
                arrived &= np.linalg.norm(self._turn(commanded), axis=-1) < _TURNED
            self._dwell[arrived] += 1
            self._spent[rows] += 1
            ready = (arrived & (self._dwell >= phase.dwell)) | (rows & (self._spent >= phase.limit))
            if index == len(self.phases) - 1:
                ready = self._again(scene, rows, following)
            else:
                self._note_misses(index, goal, ready)
                following[ready] += 1
            if phase.still is not None:
                lost = rows & ~phase.still(scene)
                if lost.any():
                    done = self._done(scene, index)
                    self._say_why(bisect_right(self._ends, index), lost & ~done)
                    following[lost] = np.where(done, self._let_go(index), phase.again)[lost]
                    ready |= lost
            self._dwell[ready], self._spent[ready], self._memory[ready] = 0, 0, np.nan
        self.phase = following
        action[:, 3:6] = np.clip(self._turn(commanded) / ROTATION_STEP, -0.3, 0.3)
        return action

    @property
    def carrying(self) -> np.ndarray:
        """``[n]`` bool: the row is in a phase that carries something, after the latest call."""
        carries = np.array([phase.carries for phase in self.phases])
        return carries[self.phase]

    def _turn(self, commanded: np.ndarray) -> np.ndarray:
        """Rotation vectors ``[n, 3]`` from the commanded rotations ``[n, 3, 3]`` to the wanted ones."""
        cos, sin = np.cos(self._yaw), np.sin(self._yaw)
        wanted = np.zeros_like(commanded)
        wanted[:, 0, 0], wanted[:, 1, 0], wanted[:, 0, 1], wanted[:, 1, 1] = cos, sin, sin, -cos
        wanted[:, 2, 2] = -1.0
        return controller.vector_from_rotation(wanted @ commanded.swapaxes(1, 2))

    def _done(self, scene: SceneBatch, index: int) -> np.ndarray:
        """``[n]``: what the phase's stage is for holds already."""
        return self._relations.evaluate(scene, *self._stages[bisect_right(self._ends, index)].aim)

    def _note_misses(self, index: int, goal: np.ndarray, ended: np.ndarray) -> None:
        """Keeps where rows have ``ended [n]`` a phase although its ``goal [n, 3]`` is out of the arm's reach.

        In the first attempt only: in a later one things may lie where the hand has pushed them.
        """
        if ended.any():
            missed = ended & ~self._failed & (out_of_reach(goal) > self.phases[index].tolerance)
            self._missed[missed, bisect_right(self._ends, index)] = goal[missed]

    def _say_why(self, stage: int, failed: np.ndarray) -> None:
        """Warns, once for each stage, if rows that ``failed [n]`` at it could not reach where they had to be."""
        self._failed |= failed
        rows = np.flatnonzero(failed & ~np.isnan(self._missed[:, stage, 0]))
        if not self._warn or stage in self._said or not len(rows):
            return
        self._said.add(stage)
        goal = self._missed[rows[:1], stage]
        far, (x, y) = 100 * out_of_reach(goal)[0], goal[0, :2] - setting_of(self.task.problem).origin
        warnings.warn(
            f"{self.task.name}: the expert fails at ({' '.join(self._stages[stage].aim)}) in row {rows[0]}: the hand "
            f"would have to be at x = {x:.2f}, y = {y:.2f} of the workspace, {far:.0f} cm out of the arm's reach; "
            "if it was not pushed there, move the thing, or where it belongs, in the task file",
            stacklevel=2,
        )

    def _let_go(self, index: int) -> int:
        """The last but one phase of the same stage: the hand opens and leaves."""
        return max(index, self._ends[bisect_right(self._ends, index)] - 2)

    def _again(self, scene: SceneBatch, rows: np.ndarray, following: np.ndarray) -> np.ndarray:
        """Sends those of ``rows`` that have waited at the end back to the first stage whose aim does not hold."""
        waited = rows & (self._spent >= _PATIENCE)
        if not waited.any():
            return waited
        left = waited.copy()
        for number, (stage, start) in enumerate(zip(self._stages, (0, *self._ends), strict=False)):
            failed = left & ~self._relations.evaluate(scene, *stage.aim)
            self._say_why(number, failed)
            following[failed] = start
            left &= ~failed
        return waited
