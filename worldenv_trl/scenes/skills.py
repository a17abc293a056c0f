"""Skills of the scripted expert: phases that move the hand from waypoint to waypoint, over all rows at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.relations import inside

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

OPEN, CLOSE = -1.0, 1.0
_HOVER = 0.11  # above what is gripped, before the hand goes down
_CLEAR = 0.06  # between the bottom of what is carried and what it is carried over


@dataclass(frozen=True)
class Phase:
    """Go to ``target(scene, memory) [n, 3]`` until within ``tolerance`` for ``dwell`` steps, or for ``limit`` at most.

    ``remember(scene) [n, 3]`` is read once on entry and handed to ``target`` as its memory. A row where
    ``still(scene) [n]`` is false has lost what it worked on and starts over, at phase ``again``.
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


def body(scene: SceneBatch, name: str) -> np.ndarray:
    """Origin of a thing, ``[n, 3]``."""
    return scene.xpos[:, scene.model.body(f"{name}/").id]


def tcp(scene: SceneBatch) -> np.ndarray:
    """The point between the fingertips, ``[n, 3]`` (a copy)."""
    return scene.site_xpos[:, scene.model.site("panda/tcp").id].copy()


def pick_and_place(task: FileTask, thing: str, place: str, again: int) -> list[Phase]:
    """Phases that put ``thing`` on or into ``place``, a thing or a region; they start over at phase ``again``.

    Raises:
        ValueError: for a thing that cannot be gripped.
    """
    entities, relations = task.entities, task.relations
    grasp = entities[thing].grasp
    if grasp is None:
        raise ValueError(f"no script for {task.name}: {thing} cannot be gripped")
    owner, part = relations.part(place)

    def grip(scene: SceneBatch, height: float = 0.0) -> np.ndarray:
        x, y, z = grasp.offset
        axes = scene.xmat[:, scene.model.body(f"{thing}/").id].reshape(-1, 3, 3)
        beside = axes @ np.array((x, y, 0.0))
        return body(scene, thing) + beside + np.array((0.0, 0.0, z + height))

    def goal(scene: SceneBatch) -> np.ndarray:
        """Where the thing's origin should come to rest."""
        if not part:
            return np.add(body(scene, owner), (0.0, 0.0, entities[owner].surface))
        center, axes, half = relations.box(scene, owner, part)
        on_top = owner not in entities or entities[owner].regions[part].on_top
        return center - (0.0 if on_top else half[2]) * axes[:, :, 2]

    def over(scene: SceneBatch, height: float) -> np.ndarray:
        return goal(scene) + (tcp(scene) - body(scene, thing)) + (0.0, 0.0, height)

    def up(scene: SceneBatch) -> np.ndarray:
        """Straight up until the thing clears its goal, and what stands around it."""
        lift = np.maximum(goal(scene)[:, 2] - body(scene, thing)[:, 2], 0.0) + _rim(entities, owner, part) + _CLEAR
        return tcp(scene) + np.stack([np.zeros_like(lift), np.zeros_like(lift), lift], -1)

    def held(scene: SceneBatch) -> np.ndarray:
        return np.linalg.norm(tcp(scene) - grip(scene), axis=-1) < 0.04

    def placed(scene: SceneBatch) -> np.ndarray:
        if part and owner in entities and not entities[owner].regions[part].on_top:
            return inside(body(scene, thing), *relations.box(scene, owner, part))
        return np.linalg.norm((body(scene, thing) - goal(scene))[:, :2], axis=-1) < 0.05

    def away(scene: SceneBatch) -> np.ndarray:
        return np.add(tcp(scene), (0.0, 0.0, high + 0.04))

    high, low = _rim(entities, owner, part) + _CLEAR, grasp.release - 0.001
    phases = [
        Phase(lambda s, m: grip(s, _HOVER), OPEN, tolerance=0.025),
        Phase(lambda s, m: grip(s), OPEN, tolerance=0.006, limit=18),
        Phase(lambda s, m: m, CLOSE, tolerance=0.03, dwell=6, remember=grip),
        Phase(lambda s, m: m, CLOSE, tolerance=0.02, remember=up),
        Phase(lambda s, m: over(s, high), CLOSE, tolerance=0.012, limit=30, still=held),
        # Slow at the end, so that it is set down rather than dropped.
        Phase(lambda s, m: over(s, low), CLOSE, tolerance=0.005, speed=0.2, limit=20, still=held),
        Phase(lambda s, m: m, OPEN, tolerance=0.03, dwell=5, remember=tcp),
        Phase(lambda s, m: m, OPEN, tolerance=0.02, remember=away, still=placed),
    ]
    return [replace(phase, again=again) for phase in phases]


def _rim(entities, owner: str, part: str) -> float:
    """Height of what has to be cleared around the goal, over the goal."""
    if owner not in entities:
        return 0.0
    entity = entities[owner]
    if not part:
        return max(0.0, entity.height - entity.surface)
    region = entity.regions[part]
    return 0.0 if region.on_top else max(0.0, entity.height - (region.center[2] - region.half_size[2]))
