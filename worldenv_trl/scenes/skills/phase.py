"""What a skill is made of: phases that move the hand from waypoint to waypoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

OPEN, CLOSE = -1.0, 1.0
FINGER_HALF = 0.0105  # half the fingers' thickness along the hand's x axis, m
_MIDDLE, _KEPT = np.pi / 4, 0.3  # rad: of the wrist's range; how near to its yaw the hand is left in peace
FINGERTIP = 0.0075  # how far they reach below the point between them


@dataclass(frozen=True)
class Phase:
    """Go to ``target(scene, memory) [n, 3]`` until within ``tolerance`` for ``dwell`` steps, or for ``limit`` at most.

    ``remember(scene) [n, 3]`` is read once on entry and handed to ``target`` as its memory. A row where
    ``still(scene) [n]`` is false has lost what it worked on and starts over, at phase ``again``. ``yaw(scene) [n]``
    turns the hand (rad, 0: fingers along y); it stays until another phase turns it. A ``gentle`` phase starts and ends
    slowly, so that what is carried does not swing.
    """

    target: Callable[[SceneBatch, np.ndarray], np.ndarray]
    gripper: float
    tolerance: float = 0.008
    dwell: int = 1
    speed: float = 0.45
    limit: int = 14
    remember: Callable[[SceneBatch], np.ndarray] | None = None
    still: Callable[[SceneBatch], np.ndarray] | None = None
    again: int = 0
    yaw: Callable[[SceneBatch], np.ndarray] | None = None
    gentle: bool = False

    @property
    def carries(self) -> bool:
        """Whether something hangs in the closed hand, which the phase checks."""
        return self.gripper == CLOSE and self.still is not None and self.gentle


def body(scene: SceneBatch, name: str) -> np.ndarray:
    """Origin of a thing, ``[n, 3]``."""
    return scene.xpos[:, scene.model.body(f"{name}/").id]


def axes(scene: SceneBatch, name: str) -> np.ndarray:
    """Axes of a thing (the columns), ``[n, 3, 3]``."""
    return scene.xmat[:, scene.model.body(f"{name}/").id].reshape(-1, 3, 3)


def tcp(scene: SceneBatch) -> np.ndarray:
    """The point between the fingertips, ``[n, 3]`` (a copy)."""
    return scene.site_xpos[:, scene.model.site("panda/tcp").id].copy()


def joint(scene: SceneBatch, name: str) -> np.ndarray:
    """Position of a joint, ``[n]``."""
    return scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(name).id]]


def upwards(height: np.ndarray | float) -> np.ndarray:
    """``[n, 3]`` (or ``[3]``) vectors of that height."""
    return np.multiply.outer(height, (0.0, 0.0, 1.0))


def half_turn(angle: np.ndarray) -> np.ndarray:
    """The yaw in (-pi/2, pi/2] that puts the same fingers along the same line."""
    return (angle + np.pi / 2 - 1e-6) % np.pi - np.pi / 2 + 1e-6


def wrist_yaw(wanted: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Of the yaws ``[n]`` (rad) that lay the fingers along ``wanted``, the one in the middle of the wrist's range.

    So the hand turns the same way for all things that lie alike, and things mostly lie along the table or across it:
    the nearest to home would be this way for half of those that lie across, that way for the others. A yaw that the
    hand has ``now`` but for a little it keeps, as far as the wrist goes.
    """
    kept, middle = now + half_turn(wanted - now), _MIDDLE + half_turn(wanted - _MIDDLE)
    near = (np.abs(kept - now) < _KEPT) & (np.abs(kept - _MIDDLE) < np.pi / 2 + _KEPT)
    return np.where(near, kept, middle)
