"""A scripted expert with privileged state, composed of waypoints, batched over rows.

Each step it looks at the true state again, so actions disturbed from outside are corrected as far as they can be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.keys import ACTION_DIM, POSITION_STEP, ROTATION_STEP
from worldenv_trl.scenes import controller, predicates
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Bowl, Plate
from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.skills import CLOSE, OPEN, Phase, body, pick_and_place, tcp

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch
    from worldenv_trl.scenes.tasks import Task

_DOWN = np.diag([1.0, -1.0, -1.0])  # the hand points straight down, fingers open along y


class ScriptedExpert:
    """Solves one task; ``expert(scene)`` gives normalised actions ``[n, 7]``.

    Args:
        task: a task of the ``goal`` suite, or of a file that asks for things to be put on or into others.

    Raises:
        ValueError: for a task nobody wrote a script for.
    """

    def __init__(self, task: Task) -> None:
        self._phases = _phases(task)
        self.reset()

    def reset(self, rows: np.ndarray | None = None) -> None:
        """Starts ``rows`` (default: all) from the first phase."""
        if rows is None:
            self._phase = None
        elif self._phase is not None:
            self._phase[rows], self._dwell[rows], self._spent[rows], self._memory[rows] = 0, 0, 0, np.nan

    def __call__(self, scene: SceneBatch) -> np.ndarray:
        """Actions ``[n, 7]`` in [-1, 1] for the current state of every row."""
        n = scene.num_envs
        if self._phase is None or len(self._phase) != n:
            self._phase, self._dwell, self._spent = (np.zeros(n, int) for _ in range(3))
            self._memory = np.full((n, 3), np.nan)
        position = scene.measured_state()[:, :3].astype(float)
        targets = scene.batch.bind("userdata")
        action, following = np.zeros((n, ACTION_DIM)), self._phase.copy()
        for index, phase in enumerate(self._phases):
            rows = self._phase == index
            if not rows.any():
                continue
            if phase.remember is not None:
                fresh = rows & np.isnan(self._memory[:, 0])
                self._memory[fresh] = phase.remember(scene)[fresh]
            goal = phase.target(scene, self._memory)
            error = goal - targets[:, :3]
            length = np.linalg.norm(error, axis=-1, keepdims=True)
            step = error / POSITION_STEP * np.minimum(1.0, phase.speed * POSITION_STEP / np.maximum(length, 1e-9))
            action[rows, :3], action[rows, 6] = step[rows], phase.gripper
            arrived = rows & (np.linalg.norm(goal - position, axis=-1) < phase.tolerance)
            self._dwell[arrived] += 1
            self._spent[rows] += 1
            ready = (arrived & (self._dwell >= phase.dwell)) | (rows & (self._spent >= phase.limit))
            if index == len(self._phases) - 1:
                ready[:] = False
            following[ready] += 1
            if phase.still is not None:
                lost = rows & ~phase.still(scene)
                following[lost] = phase.again
                ready |= lost
            self._dwell[ready], self._spent[ready], self._memory[ready] = 0, 0, np.nan
        self._phase = following
        turn = controller.vector_from_rotation(_DOWN @ targets[:, 3:12].reshape(-1, 3, 3).swapaxes(1, 2))
        action[:, 3:6] = np.clip(turn / ROTATION_STEP, -0.3, 0.3)
        return action


def _phases(task: Task) -> list[Phase]:
    phases: list[Phase] = []
    for predicate, *arguments in task.goal:
        if isinstance(task, FileTask) and predicate in ("On", "In"):
            phases += pick_and_place(task, *arguments, again=len(phases))
        elif isinstance(task, FileTask) or predicate not in _SCRIPTS or len(task.goal) > 1:
            known = "On, In" if isinstance(task, FileTask) else ", ".join(_SCRIPTS)
            raise ValueError(f"no script for {task.name}: its goal is {task.goal}, scripts exist for {known}")
        else:
            phases += _SCRIPTS[predicate](*arguments)
    return phases


def _put_on(bowl: str, plate: str) -> list[Phase]:
    def rim(scene: SceneBatch, height: float) -> np.ndarray:
        radius = Bowl.RIM_RADIUS - 0.004
        return np.add(body(scene, bowl), (0.0, radius, height))

    def over_plate(scene: SceneBatch, bottom: float) -> np.ndarray:
        held = tcp(scene) - body(scene, bowl)
        return body(scene, plate) + held + (0.0, 0.0, bottom)

    def held(scene: SceneBatch) -> np.ndarray:
        return np.linalg.norm(tcp(scene) - body(scene, bowl), axis=-1) < 2 * Bowl.RIM_RADIUS

    def placed(scene: SceneBatch) -> np.ndarray:
        return predicates.on(scene, bowl, plate)

    # Deep enough that the pads carry the bowl level; slow at the end, so that it is set down rather than dropped.
    grip = Bowl.HEIGHT - 0.022
    return [
        Phase(lambda s, m: rim(s, 0.11), OPEN, tolerance=0.025),
        Phase(lambda s, m: rim(s, grip), OPEN, tolerance=0.006),
        Phase(lambda s, m: m, CLOSE, tolerance=0.03, dwell=6, remember=lambda s: rim(s, grip)),
        Phase(lambda s, m: m, CLOSE, tolerance=0.02, remember=lambda s: np.add(tcp(s), (0.0, 0.0, 0.07))),
        Phase(lambda s, m: over_plate(s, 0.06), CLOSE, tolerance=0.010, still=held),
        Phase(lambda s, m: over_plate(s, Plate.TOP - 0.001), CLOSE, tolerance=0.005, speed=0.2, still=held),
        Phase(lambda s, m: m, OPEN, tolerance=0.03, dwell=5, remember=tcp),
        Phase(lambda s, m: m, OPEN, remember=lambda s: np.add(tcp(s), (0.0, 0.0, 0.10)), still=placed),
    ]


def _pull_open(cabinet: str, drawer: str) -> list[Phase]:
    def handle(scene: SceneBatch, height: float = 0.0, behind: float = 0.0) -> np.ndarray:
        bar = scene.site_xpos[:, scene.model.site(f"{cabinet}/{drawer}_handle").id]
        return np.add(bar, (0.0, -behind, height))

    def opened(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        travel = scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(f"{cabinet}/{drawer}").id]]
        further = np.zeros((len(travel), 3))
        further[:, 1] = travel - Cabinet.OPEN_BELOW
        return handle(scene) + further

    def hooked(scene: SceneBatch) -> np.ndarray:
        x, y, z = (tcp(scene) - handle(scene)).T
        return (np.abs(x) < Cabinet.HANDLE_HALF_WIDTH + 0.008) & (y < 0.0) & (y > -0.065) & (np.abs(z) < 0.025)

    # The closed fingers hook the bar from behind.
    hook = 0.5 * Cabinet.HANDLE_REACH
    return [
        Phase(lambda s, m: handle(s, 0.07, hook), CLOSE, tolerance=0.02),
        Phase(lambda s, m: handle(s, 0.0, hook), CLOSE, tolerance=0.008),
        Phase(opened, CLOSE, still=hooked),
    ]


def _push_on(stove: str) -> list[Phase]:
    def along(scene: SceneBatch, ahead: float, height: float) -> np.ndarray:
        lever = scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(f"{stove}/lever").id]]
        angle = np.minimum(lever + ahead, Stove.ON_ABOVE + 0.25) + Stove.START_ANGLE
        direction = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
        return body(scene, stove) + Stove.PIVOT + Stove.PEG_RADIUS * direction + (0.0, 0.0, height)

    return [
        Phase(lambda s, m: along(s, -0.65, 0.11), CLOSE, tolerance=0.025),
        Phase(lambda s, m: along(s, -0.65, 0.03), CLOSE, tolerance=0.008),
        Phase(lambda s, m: along(s, 0.30, 0.03), CLOSE),
    ]


_SCRIPTS: dict[str, Callable[..., list[Phase]]] = {"On": _put_on, "Open": _pull_open, "TurnOn": _push_on}
