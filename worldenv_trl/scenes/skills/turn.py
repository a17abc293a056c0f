"""Pull drawers open, push drawers and doors closed, turn levers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from worldenv_trl.scenes.entities import Primitive
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet, Microwave
from worldenv_trl.scenes.skills.clearance import travel
from worldenv_trl.scenes.skills.phase import CLOSE, FINGER_HALF, OPEN, Phase, axes, body, half_turn, joint, tcp, upwards

if TYPE_CHECKING:
    from worldenv_trl.scenes.files import FileTask
    from worldenv_trl.scenes.simulation import SceneBatch

_Fixture = TypeVar("_Fixture", bound=Primitive)

_OVER = 0.07  # above where the fingers go down
_BEYOND = 0.012  # how far a drawer is pulled past where it counts as open, m
_STOP = 0.03  # how far a drawer or door is pushed into its stop, m


def pull_open(task: FileTask, thing: str, part: str, again: int) -> list[Phase]:
    """Phases that hook a drawer's handle from behind with closed fingers and pull it open."""
    cabinet = _fixture(task, thing, Cabinet, "pulled open")
    drawer = part.removesuffix("_region")
    grip = cabinet.BAR + FINGER_HALF + 0.004

    def hook(scene: SceneBatch, height: float = 0.0) -> np.ndarray:
        return _handle(scene, thing, drawer) - grip * _outwards(scene, thing) + upwards(height)

    def pulled(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        missing = joint(scene, f"{thing}/{drawer}") - (cabinet.OPEN_BELOW - _BEYOND)
        lead = np.clip(missing, 0.0, 0.06) + (grip - FINGER_HALF - cabinet.BAR) * (missing > 0)
        return hook(scene) + lead[:, None] * _outwards(scene, thing)

    def hooked(scene: SceneBatch) -> np.ndarray:
        offset = tcp(scene) - hook(scene)
        return np.linalg.norm(offset, axis=-1) < 0.035

    def opened(scene: SceneBatch) -> np.ndarray:
        return joint(scene, f"{thing}/{drawer}") < cabinet.OPEN_BELOW

    work = Phase(pulled, CLOSE, tolerance=0.006, limit=60, still=hooked)
    return _stroke(task, again, hook, (0.012, 0.006), lambda s: _across(s, thing), work, done=opened)


def push_closed(task: FileTask, thing: str, part: str, again: int) -> list[Phase]:
    """Phases that push a drawer or a microwave's door closed with closed fingers.

    They close on the way down: a closed hand high above looks, to a policy without memory, like one that still carries.
    """
    if isinstance(task.entities[thing], Microwave):
        return _close_door(task, thing, again)
    cabinet = _fixture(task, thing, Cabinet, "pushed closed")
    drawer = part.removesuffix("_region")
    reach = cabinet.BAR + FINGER_HALF

    def before(scene: SceneBatch, height: float = 0.0, gap: float = 0.015) -> np.ndarray:
        return _handle(scene, thing, drawer) + (reach + gap) * _outwards(scene, thing) + upwards(height)

    def pushed(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        return before(scene, gap=0.0) - _STOP * _outwards(scene, thing)

    work = Phase(pushed, CLOSE, tolerance=0.004, limit=40)
    return _stroke(task, again, before, (0.015, 0.010), lambda s: _across(s, thing), work, on_the_way=OPEN)


def _close_door(task: FileTask, thing: str, again: int) -> list[Phase]:
    oven = _fixture(task, thing, Microwave, "pushed closed")
    x, y, z = oven.HALF
    hinge, radius, high = np.array((-x, -y - 0.006, 0.0)), 0.13, 2 * z - 0.015

    def beside(scene: SceneBatch, ahead: float, height: float, gap: float) -> np.ndarray:
        """Outside the door, ``ahead`` of it by an angle (rad)."""
        angle = np.minimum(joint(scene, f"{thing}/door") + ahead, 0.15)
        nothing = np.zeros_like(angle)
        along = np.stack([np.cos(angle), np.sin(angle), nothing], -1)
        outside = np.stack([np.sin(angle), -np.cos(angle), nothing], -1)
        local = hinge + radius * along + (0.006 + FINGER_HALF + gap) * outside
        return body(scene, thing) + np.einsum("nij,nj->ni", axes(scene, thing), local) + upwards(height)

    def before(scene: SceneBatch, height: float = 0.0) -> np.ndarray:
        return beside(scene, -0.25, high + height, 0.03)

    work = Phase(lambda s, m: beside(s, 0.30, high, 0.0), CLOSE, tolerance=0.004, limit=70)
    return _stroke(task, again, before, (0.02, 0.012), _straight, work, on_the_way=OPEN)


def turn(task: FileTask, thing: str, again: int, on: bool = True) -> list[Phase]:
    """Phases that push a stove's lever past where it counts as on, or back to off, with closed fingers."""
    stove = _fixture(task, thing, Stove, "turned")
    sign = 1.0 if on else -1.0
    last = stove.ON_ABOVE + 0.25 if on else 0.0

    def along(scene: SceneBatch, ahead: float, height: float) -> np.ndarray:
        lever = joint(scene, f"{thing}/lever")
        angle = lever + sign * ahead
        angle = (np.minimum(angle, last) if on else np.maximum(angle, last)) + stove.START_ANGLE
        direction = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
        local = np.add(stove.PIVOT, stove.PEG_RADIUS * direction)
        return body(scene, thing) + np.einsum("nij,nj->ni", axes(scene, thing), local) + upwards(height)

    behind = -0.055 / stove.PEG_RADIUS

    def before(scene: SceneBatch, height: float = 0.0) -> np.ndarray:
        return along(scene, behind, 0.03 + height)

    work = Phase(lambda s, m: along(s, 0.35, 0.03), CLOSE, tolerance=0.012, limit=40)
    return _stroke(task, again, before, (0.02, 0.008), _straight, work, over=0.08)


def _stroke(
    task: FileTask,
    again: int,
    start: Callable[..., np.ndarray],
    tolerances: tuple[float, float],
    yaw: Callable[[SceneBatch], np.ndarray],
    work: Phase,
    *,
    over: float = _OVER,
    on_the_way: float = CLOSE,
    done: Callable[[SceneBatch], np.ndarray] | None = None,
) -> list[Phase]:
    """The hand travels to ``over`` the ``start(scene, height)``, goes down closed, does the ``work`` and leaves.

    ``on_the_way`` is what the gripper does on its travel; ``tolerances`` are those of the travel and of the way down;
    ``done`` is what must still hold on the way up.
    """
    phases = [
        Phase(lambda s, m: travel(s, task, start(s, over)), on_the_way, tolerance=tolerances[0], limit=40, yaw=yaw),
        Phase(lambda s, m: start(s), CLOSE, tolerance=tolerances[1], limit=20),
        work,
        Phase(lambda s, m: m + upwards(0.10), CLOSE, tolerance=0.02, remember=tcp, still=done),
    ]
    return [replace(phase, again=again) for phase in phases]


def _fixture(task: FileTask, thing: str, kind: type[_Fixture], what: str) -> _Fixture:
    entity = task.entities[thing]
    if not isinstance(entity, kind):
        raise ValueError(f"no script for {task.name}: {thing} cannot be {what}")
    return entity


def _handle(scene: SceneBatch, thing: str, drawer: str) -> np.ndarray:
    return scene.site_xpos[:, scene.model.site(f"{thing}/{drawer}_handle").id]


def _outwards(scene: SceneBatch, thing: str) -> np.ndarray:
    """The way drawers open, ``[n, 3]``."""
    return axes(scene, thing)[:, :, 1]


def _across(scene: SceneBatch, thing: str) -> np.ndarray:
    """The yaw that lays the palm along the cabinet's front."""
    way = _outwards(scene, thing)
    return half_turn(np.arctan2(way[:, 1], way[:, 0]))


def _straight(scene: SceneBatch) -> np.ndarray:
    return np.zeros(scene.num_envs)
