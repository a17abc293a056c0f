"""A scripted expert with privileged state, composed of waypoints, batched over rows.

Each step it looks at the true state again, so actions disturbed from outside are corrected as far as they can be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.keys import ACTION_DIM, POSITION_STEP, ROTATION_STEP
from worldenv_trl.scenes import controller, predicates
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Bowl, Plate

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch
    from worldenv_trl.scenes.tasks import Task

_DOWN = np.diag([1.0, -1.0, -1.0])  # the hand points straight down, fingers open along y
_OPEN, _CLOSE = -1.0, 1.0


@dataclass(frozen=True)
class _Phase:
    """Go to ``target(scene, memory) [n, 3]`` until within ``tolerance`` for ``dwell`` steps, or for ``limit`` at most.

    ``remember(scene) [n, 3]`` is read once on entry and handed to ``target`` as its memory. A row where
    ``still(scene) [n]`` is false has lost what it worked on and starts over.
    """

    target: Callable[[SceneBatch, np.ndarray], np.ndarray]
    gripper: float
    tolerance: float = 0.008
    dwell: int = 1
    speed: float = 0.45
    limit: int = 14
    remember: Callable[[SceneBatch], np.ndarray] | None = None
    still: Callable[[SceneBatch], np.ndarray] | None = None


class ScriptedExpert:
    """Solves one task; ``expert(scene)`` gives normalised actions ``[n, 7]``.

    Args:
        task: a task of the ``goal`` suite.

    Raises:
        ValueError: for a task nobody wrote a script for.
    """

    def __init__(self, task: Task) -> None:
        predicate, *arguments = task.goal[0]
        if len(task.goal) != 1 or predicate not in _SCRIPTS or not task.placements:
            raise ValueError(
                f"no script for {task.name}: its goal is {task.goal}, scripts exist for {', '.join(_SCRIPTS)}"
            )
        self._phases = _SCRIPTS[predicate](*arguments)
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
                following[lost] = 0
                ready |= lost
            self._dwell[ready], self._spent[ready], self._memory[ready] = 0, 0, np.nan
        self._phase = following
        turn = controller.vector_from_rotation(_DOWN @ targets[:, 3:12].reshape(-1, 3, 3).swapaxes(1, 2))
        action[:, 3:6] = np.clip(turn / ROTATION_STEP, -0.3, 0.3)
        return action


def _put_on(bowl: str, plate: str) -> list[_Phase]:
    def rim(scene: SceneBatch, height: float) -> np.ndarray:
        radius = Bowl.RIM_RADIUS - 0.004
        return np.add(_body(scene, bowl), (0.0, radius, height))

    def over_plate(scene: SceneBatch, bottom: float) -> np.ndarray:
        held = _tcp(scene) - _body(scene, bowl)
        return _body(scene, plate) + held + (0.0, 0.0, bottom)

    def held(scene: SceneBatch) -> np.ndarray:
        return np.linalg.norm(_tcp(scene) - _body(scene, bowl), axis=-1) < 2 * Bowl.RIM_RADIUS

    def placed(scene: SceneBatch) -> np.ndarray:
        return predicates.on(scene, bowl, plate)

    # Deep enough that the pads carry the bowl level; slow at the end, so that it is set down rather than dropped.
    grip = Bowl.HEIGHT - 0.022
    return [
        _Phase(lambda s, m: rim(s, 0.11), _OPEN, tolerance=0.025),
        _Phase(lambda s, m: rim(s, grip), _OPEN, tolerance=0.006),
        _Phase(lambda s, m: m, _CLOSE, tolerance=0.03, dwell=6, remember=lambda s: rim(s, grip)),
        _Phase(lambda s, m: m, _CLOSE, tolerance=0.02, remember=lambda s: np.add(_tcp(s), (0.0, 0.0, 0.07))),
        _Phase(lambda s, m: over_plate(s, 0.06), _CLOSE, tolerance=0.010, still=held),
        _Phase(lambda s, m: over_plate(s, Plate.TOP - 0.001), _CLOSE, tolerance=0.005, speed=0.2, still=held),
        _Phase(lambda s, m: m, _OPEN, tolerance=0.03, dwell=5, remember=_tcp),
        _Phase(lambda s, m: m, _OPEN, remember=lambda s: np.add(_tcp(s), (0.0, 0.0, 0.10)), still=placed),
    ]


def _pull_open(cabinet: str, drawer: str) -> list[_Phase]:
    def handle(scene: SceneBatch, height: float = 0.0, behind: float = 0.0) -> np.ndarray:
        bar = scene.site_xpos[:, scene.model.site(f"{cabinet}/{drawer}_handle").id]
        return np.add(bar, (0.0, -behind, height))

    def opened(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        travel = scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(f"{cabinet}/{drawer}").id]]
        further = np.zeros((len(travel), 3))
        further[:, 1] = travel - Cabinet.OPEN_BELOW
        return handle(scene) + further

    def hooked(scene: SceneBatch) -> np.ndarray:
        x, y, z = (_tcp(scene) - handle(scene)).T
        return (np.abs(x) < Cabinet.HANDLE_HALF_WIDTH + 0.008) & (y < 0.0) & (y > -0.065) & (np.abs(z) < 0.025)

    # The closed fingers hook the bar from behind.
    hook = 0.5 * Cabinet.HANDLE_REACH
    return [
        _Phase(lambda s, m: handle(s, 0.07, hook), _CLOSE, tolerance=0.02),
        _Phase(lambda s, m: handle(s, 0.0, hook), _CLOSE, tolerance=0.008),
        _Phase(opened, _CLOSE, still=hooked),
    ]


def _push_on(stove: str) -> list[_Phase]:
    def along(scene: SceneBatch, ahead: float, height: float) -> np.ndarray:
        lever = scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(f"{stove}/lever").id]]
        angle = np.minimum(lever + ahead, Stove.ON_ABOVE + 0.25) + Stove.START_ANGLE
        direction = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
        return _body(scene, stove) + Stove.PIVOT + Stove.PEG_RADIUS * direction + (0.0, 0.0, height)

    return [
        _Phase(lambda s, m: along(s, -0.65, 0.11), _CLOSE, tolerance=0.025),
        _Phase(lambda s, m: along(s, -0.65, 0.03), _CLOSE, tolerance=0.008),
        _Phase(lambda s, m: along(s, 0.30, 0.03), _CLOSE),
    ]


_SCRIPTS: dict[str, Callable[..., list[_Phase]]] = {"On": _put_on, "Open": _pull_open, "TurnOn": _push_on}


def _body(scene: SceneBatch, name: str) -> np.ndarray:
    return scene.xpos[:, scene.model.body(f"{name}/").id]


def _tcp(scene: SceneBatch) -> np.ndarray:
    return scene.site_xpos[:, scene.model.site("panda/tcp").id].copy()
