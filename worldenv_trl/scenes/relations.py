"""Goal predicates of task files, with LIBERO's meaning (arXiv 2306.03310, read off its code), for all rows at once.

Two things differ on purpose. The origin of our things is where they rest, LIBERO's is somewhere inside, so heights are
measured from the bottom. And a region is a box in its own axes; LIBERO's is right for multiples of 90 degrees only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from worldenv_trl.scenes.bddl import Problem
from worldenv_trl.scenes.entities import Primitive
from worldenv_trl.scenes.settings import joint_of, part_of

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

__all__ = ["Relations", "inside", "within"]

ON_DISTANCE = 0.03  # horizontal distance of the origins of two things, one on the other
STANDS_BETWEEN = (-0.005, 0.10)  # height over a region's upper face
SINKS = 0.01  # how far below a region's floor something inside it may be


def within(points: np.ndarray, center: np.ndarray, rotation: np.ndarray, half_size: np.ndarray) -> np.ndarray:
    """``[n]``: points ``[n, 3]`` stand on the upper face of boxes with centres ``[n, 3]`` and axes ``[n, 3, 3]``."""
    x, y, z = _local(points, center, rotation).T
    low, high = half_size[2] + np.array(STANDS_BETWEEN)
    return (np.abs(x) < half_size[0]) & (np.abs(y) < half_size[1]) & (low < z) & (z < high)


def inside(points: np.ndarray, center: np.ndarray, rotation: np.ndarray, half_size: np.ndarray) -> np.ndarray:
    """``[n]``: points ``[n, 3]`` are in the boxes, or at most a centimetre below their floor."""
    local = _local(points, center, rotation)
    low = -np.array(half_size) - (0.0, 0.0, SINKS)
    return np.all((low < local) & (local < half_size), -1)


def _local(points: np.ndarray, center: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.einsum("nji,nj->ni", rotation, points - center)


class Relations:
    """Evaluates the goal of a task file.

    Args:
        problem: the parsed file.
        entities: every fixture and object by name.
        model: the compiled scene.
        origin: where the workspace's (0, 0) lies on our table (m).

    Raises:
        BDDLError: if a predicate of the goal cannot be evaluated with these things, naming file and line.
    """

    def __init__(
        self,
        problem: Problem,
        entities: Mapping[str, Primitive],
        model: mujoco.MjModel,
        origin: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.problem, self.entities, self.model = problem, entities, model
        self.origin = np.array((*origin, 0.0))
        self._data = mujoco.MjData(model)
        for whole in problem.goal:
            if whole[0] not in ("On", "In"):
                joint_of(problem, entities, "goal", whole)
            elif message := self.why_not(*whole):
                raise problem.error("goal", *whole, message=message)

    def why_not(self, predicate: str, thing: str, place: str) -> str | None:
        """Why ``On`` or ``In`` can never hold of ``thing`` and ``place``, or None; ``BDDLError`` for no such region."""
        if thing not in self.problem.objects:
            why = "is a fixture, which never moves" if thing in self.entities else "is not a thing"
            return f"{thing} {why}: it cannot be put somewhere"
        if place not in self.entities and place not in self.problem.regions:
            return f"{place} is the workspace: name one of its regions"
        owner, part = self.part(place)
        message = None
        if owner == thing:
            message = f"{thing} cannot be put on or into itself"
        elif owner in self.entities:
            regions = self.entities[owner].regions
            if predicate == "In" and not part and "contain_region" not in regions:
                inside = [f"{owner}_{name}" for name, region in regions.items() if not region.on_top]
                rest = f"name one of {', '.join(inside)} (in :regions)" if inside else "did you mean On?"
                message = f"{owner} has no contain_region: {rest}"
        elif not self.problem.regions[place].ranges:
            message = f"region {place} has no (:ranges ...)"
        elif predicate == "In":
            message = f"{place} is flat: nothing is in it, say On"
        else:
            x_low, y_low, x_high, y_high = self.problem.regions[place].ranges[0]
            if x_low == x_high or y_low == y_high:
                message = f"the first range of {place} is a line or a point: nothing can stand within it"
        return message

    def holds(self, scene: SceneBatch) -> np.ndarray:
        """``[n]`` bool: the whole goal holds in the current state of each row."""
        result = np.ones(scene.num_envs, bool)
        for predicate, *arguments in self.problem.goal:
            result &= self.evaluate(scene, predicate, *arguments)
        return result

    def evaluate(self, scene: SceneBatch, predicate: str, *arguments: str) -> np.ndarray:
        """``[n]`` bool: one predicate."""
        if predicate == "On":
            return self._on(scene, *arguments)
        if predicate == "In":
            return self._in(scene, *arguments)
        thing, part = self.part(arguments[0])
        state = self.entities[thing].states[predicate, part]
        position = scene.qpos[:, self.model.joint(f"{thing}/{state.joint}").qposadr[0]]
        return (state.low <= position) & (position <= state.high)

    def part(self, name: str) -> tuple[str, str]:
        """The entity, or workspace, and its region (or "") that ``name`` means."""
        return part_of(self.problem, self.entities, name)

    def _position(self, scene: SceneBatch, thing: str) -> np.ndarray:
        return scene.xpos[:, self.model.body(f"{thing}/").id]

    def half_size(self, thing: str, part: str) -> np.ndarray:
        """Half size ``[3]`` of a region of a thing."""
        return np.array(self.entities[thing].regions[part].half_size)

    def box(self, scene: SceneBatch, thing: str, part: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centre ``[n, 3]``, axes ``[n, 3, 3]`` and half size ``[3]`` of a region."""
        if thing in self.entities:
            site = self.model.site(f"{thing}/{part}").id
            axes = scene.site_xmat[:, site].reshape(-1, 3, 3)
            return scene.site_xpos[:, site], axes, self.half_size(thing, part)
        low_x, low_y, high_x, high_y = self.problem.regions[f"{thing}_{part}"].ranges[0]  # LIBERO: the first one
        center = self.origin + np.array(((low_x + high_x) / 2, (low_y + high_y) / 2, 0.0))
        half = np.array(((high_x - low_x) / 2, (high_y - low_y) / 2, 0.0))
        n = scene.num_envs
        return np.broadcast_to(center, (n, 3)), np.broadcast_to(np.eye(3), (n, 3, 3)), half

    # ------------------------------------------------------------------------------------------------- On, In

    def _on(self, scene: SceneBatch, top: str, below: str) -> np.ndarray:
        thing, part = self.part(below)
        if not part:
            offset = self._position(scene, top) - self._position(scene, thing)
            near = (offset[:, 2] >= 0) & (np.hypot(offset[:, 0], offset[:, 1]) < ON_DISTANCE)
            return self._touching(scene, near, top, thing)
        near = within(self._position(scene, top), *self.box(scene, thing, part))
        return near if thing not in self.entities else self._touching(scene, near, top, thing)

    def _in(self, scene: SceneBatch, thing: str, place: str) -> np.ndarray:
        owner, part = self.part(place)
        if owner in self.entities and not part:
            part = "contain_region"
        return inside(self._position(scene, thing), *self.box(scene, owner, part))

    def _touching(self, scene: SceneBatch, rows: np.ndarray, first: str, second: str) -> np.ndarray:
        """Those of ``rows [n]`` in which two things are in contact; contacts are searched in no other row."""
        touching = np.zeros_like(rows)
        roots = [self.model.body(f"{name}/").id for name in (first, second)]
        for row in np.flatnonzero(rows):
            scene.load(self._data, int(row))
            mujoco.mj_kinematics(self.model, self._data)
            mujoco.mj_comPos(self.model, self._data)
            mujoco.mj_collision(self.model, self._data)
            pairs = self.model.body_rootid[self.model.geom_bodyid[self._data.contact.geom]]  # [contacts, 2]
            touching[row] = bool((np.sort(pairs, -1) == np.sort(roots)).all(-1).any())
        return touching
