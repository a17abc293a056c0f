"""Pick a thing up, carry it over what stands in the way, and set it down."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.relations import inside
from worldenv_trl.scenes.skills.clearance import travel
from worldenv_trl.scenes.skills.grips import grips
from worldenv_trl.scenes.skills.phase import CLOSE, OPEN, Phase, axes, body, tcp

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

_HOVER = 0.07  # above what is gripped, before the hand goes down
_CLEAR = 0.05  # between the bottom of what is carried and its place, before it goes down


def pick_and_place(
    task: FileTask, thing: str, place: str, again: int, slot: tuple[float, float] = (0.0, 0.0)
) -> list[Phase]:
    """Phases that put ``thing`` on or into ``place``, a thing or a region; they start over at phase ``again``.

    ``slot`` is where in the region, from its centre (m, along its x and y).

    Raises:
        ValueError: for a thing that cannot be gripped.
    """
    entities, relations = task.entities, task.relations
    grasp = entities[thing].grasp
    if grasp is None:
        raise ValueError(f"no script for {task.name}: {thing} cannot be gripped")
    owner, part = relations.part(place)
    into = bool(part) and owner in entities and not entities[owner].regions[part].on_top

    def grip(scene: SceneBatch, height: float = 0.0) -> np.ndarray:
        return grips(scene, task, thing, grasp)[0] + (0.0, 0.0, height)

    def yaw(scene: SceneBatch) -> np.ndarray:
        return grips(scene, task, thing, grasp)[1]

    def goal(scene: SceneBatch) -> np.ndarray:
        """Where the thing's origin should come to rest."""
        if not part:
            return np.add(body(scene, owner), (0.0, 0.0, entities[owner].surface))
        center, turned, half = relations.box(scene, owner, part)
        return center + turned @ np.array((*slot, -half[2] if into else 0.0))

    def over(scene: SceneBatch, height: float) -> np.ndarray:
        return goal(scene) + (tcp(scene) - body(scene, thing)) + (0.0, 0.0, height)

    def approach(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        return travel(scene, task, grip(scene, _HOVER), (thing,))

    def carry(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        hanging = (tcp(scene) - body(scene, thing))[:, 2]
        return travel(scene, task, over(scene, _CLEAR), (thing,), hanging)

    def held(scene: SceneBatch) -> np.ndarray:
        local = np.einsum("nji,nj->ni", axes(scene, thing), tcp(scene) - body(scene, thing))
        if grasp.kind == "rim":
            local = np.stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]], -1)
            return np.linalg.norm(local - grasp.offset[1:], axis=-1) < 0.03
        return np.linalg.norm(local - grasp.offset, axis=-1) < 0.04

    def along_place(scene: SceneBatch) -> np.ndarray:
        """The yaw that lays the thing's longer side, x, along its place's longer side."""
        _, turned, half = relations.box(scene, owner, part)
        return np.arctan2(turned[:, 1, 0], turned[:, 0, 0]) + (np.pi / 2 if half[1] > half[0] else 0.0)

    def placed(scene: SceneBatch) -> np.ndarray:
        if into:
            return inside(body(scene, thing), *relations.box(scene, owner, part))
        return np.linalg.norm((body(scene, thing) - goal(scene))[:, :2], axis=-1) < 0.05

    low, footprint = grasp.release - 0.001, entities[thing].footprint
    narrow = into and footprint is not None and min(relations.half_size(owner, part)[:2]) < np.hypot(*footprint)
    aligned = along_place if narrow and grasp.kind == "across" else None
    phases = [
        Phase(approach, OPEN, tolerance=0.020, limit=60, yaw=yaw),
        Phase(lambda s, m: grip(s), OPEN, tolerance=0.006, limit=22, yaw=yaw),
        Phase(lambda s, m: m, CLOSE, tolerance=0.03, dwell=6, remember=grip),
        Phase(lambda s, m: m, CLOSE, tolerance=0.02, remember=lambda s: np.add(tcp(s), (0.0, 0.0, 0.05)), gentle=True),
        Phase(carry, CLOSE, yaw=aligned, tolerance=0.012, limit=60, speed=0.40, still=held, gentle=True),
        # Slow at the end, so that it is set down rather than dropped.
        Phase(lambda s, m: over(s, low), CLOSE, yaw=aligned, tolerance=0.005, speed=0.2, limit=20, still=held),
        Phase(lambda s, m: m, OPEN, tolerance=0.03, dwell=5, remember=tcp),
        Phase(lambda s, m: m, OPEN, tolerance=0.02, remember=lambda s: np.add(tcp(s), (0, 0, 0.09)), still=placed),
    ]
    return [replace(phase, again=again) for phase in phases]
