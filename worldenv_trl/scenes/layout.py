"""Where things start: initial states drawn from the ``:init`` block of a task file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from worldenv_trl.scenes.bddl import Problem, Region
from worldenv_trl.scenes.entities import CATEGORIES, Primitive
from worldenv_trl.scenes.entities.registry import WORKSPACES
from worldenv_trl.scenes.settings import joint_of, part_of

GAP = 0.002  # between footprints, m
DROP = 0.001  # things start this much above what carries them
MAX_TRIES = 500
MIDDLE = 0.4  # share of the room inside a drawer or a basket that things start in: its walls are in the hand's way


@dataclass
class _Placed:
    """A footprint on the table: centre, half extents (of a circle: twice the radius) and yaw."""

    center: np.ndarray
    half: tuple[float, float]
    yaw: float
    round: bool


class Layout:
    """Draws initial states of a task file.

    Things named by ``(On thing workspace_region)`` are drawn inside one of the region's rectangles, clear of each
    other's footprints; ``Open``, ``Close``, ``TurnOn`` and ``TurnOff`` set joints; then follow the things that stand on
    or in others.

    Args:
        problem: the parsed file.
        entities: every fixture and object by name, workspaces excepted.
        model: the compiled scene, in which entity ``x`` is body ``x/``.

    Keyword Args:
        origin: where the workspace's (0, 0) lies on our table (m).

    Raises:
        BDDLError: if a thing has no place, two places, or stands on something that has none.
    """

    def __init__(
        self,
        problem: Problem,
        entities: Mapping[str, Primitive],
        model: mujoco.MjModel,
        *,
        origin: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.problem, self.entities, self.model = problem, entities, model
        self.origin = np.array(origin)
        self._on_table: list[tuple[str, Region]] = []
        self._carried: list[tuple[str, str, str]] = []  # thing, carrier, region or ""
        self._joints: list[tuple[str, str, str]] = []  # predicate, thing, region or ""
        for whole in problem.init:
            if whole[0] in ("On", "In"):
                self._place(*whole)
            else:
                thing, part = joint_of(problem, entities, "init", whole)
                if (thing, part) in {joint[1:] for joint in self._joints}:
                    raise problem.error("init", *whole, message=f"the joint of {whole[1]} is set twice in :init")
                self._joints.append((whole[0], thing, part))
        self._order()

    def _place(self, predicate: str, thing: str, place: str) -> None:
        here = ("init", predicate, thing, place)
        if thing not in self.entities:
            raise self.problem.error(*here, message=f"{thing} is a place: only objects and fixtures can be placed")
        if thing in {name for name, _ in self._on_table} | {name for name, _, _ in self._carried}:
            raise self.problem.error(*here, message=f"{thing} is placed twice in :init")
        region = self.problem.regions.get(place)
        if region is None and place not in self.entities:
            raise self.problem.error(*here, message=f"{place} is the workspace: name one of its regions")
        if region is not None and self._category(region.target) in WORKSPACES:
            if not region.ranges:
                message = f"region {place} has no (:ranges ...) to place {thing} in"
                raise self.problem.error(*here, message=message)
            self._on_table.append((thing, region))
        elif thing in self.problem.fixtures:
            message = f"{thing} is a fixture: it stands in a region of the workspace"
            raise self.problem.error(*here, message=message)
        else:
            self._carried.append((thing, *part_of(self.problem, self.entities, place)))

    def _category(self, name: str) -> str:
        return {**self.problem.fixtures, **self.problem.objects}[name]

    def _order(self) -> None:
        """Carriers before what they carry."""
        placed, waiting, ordered = {name for name, _ in self._on_table}, list(self._carried), []
        while waiting:
            ready = [item for item in waiting if item[1] in placed]
            if not ready:
                thing, carrier, _ = waiting[0]
                circular = carrier in {item[0] for item in waiting}
                lost = "stands on it in turn" if circular else "has no place in :init"
                raise self.problem.error("thing", thing, message=f"it stands on {carrier}, which {lost}")
            ordered += ready
            placed |= {item[0] for item in ready}
            waiting = [item for item in waiting if item not in ready]
        self._carried = ordered
        missing = [name for name in self.entities if name not in placed]
        if missing:
            message = f"it has no place in :init: say where it starts, (On {missing[0]} <region>)"
            raise self.problem.error("thing", missing[0], message=message)

    # ------------------------------------------------------------------------------------------------- drawing

    def draw(self, data: mujoco.MjData, rng: np.random.Generator) -> None:
        """Writes an initial state into ``data.qpos``, ``mocap_pos`` and ``mocap_quat``.

        Raises:
            RuntimeError: if things cannot be placed clear of each other, naming the hardest to place, its region and
                what is most often in its way.
        """
        failures: Counter[tuple[str, str, str]] = Counter()
        for _ in range(MAX_TRIES):
            placed, failed = self._draw_table(rng)
            if failed is None:
                break
            failures[failed] += 1
        else:
            thing, region, other = self._hardest(failures)
            where = self.problem.where("region", region)
            raise RuntimeError(
                f"{where}: {thing} cannot be placed in it clear of {other} in {MAX_TRIES} tries: move or widen the "
                "region"
            )
        for name, spot in placed.items():
            self._set_pose(data, name, (*spot.center, 0.0), spot.yaw)
        for predicate, thing, part in self._joints:
            state = self.entities[thing].states[predicate, part]
            data.qpos[self.model.joint(f"{thing}/{state.joint}").qposadr[0]] = rng.uniform(*state.start)
        for thing, carrier, part in self._carried:
            mujoco.mj_kinematics(self.model, data)
            self._set_carried(data, thing, carrier, part, rng)

    def _hardest(self, failures: Counter[tuple[str, str, str]]) -> tuple[str, str, str]:
        """Of what failed: the thing that did so in the largest share of the tries that came as far as to it."""
        left, worst, found = failures.total(), 0.0, next(iter(failures))
        for thing, _ in self._on_table:
            mine = Counter({failed: count for failed, count in failures.items() if failed[0] == thing})
            if mine.total() > worst * left:
                worst, found = mine.total() / left, mine.most_common(1)[0][0]
            left -= mine.total()
            if not left:
                break
        return found

    def _draw_table(self, rng: np.random.Generator) -> tuple[dict[str, _Placed], tuple[str, str, str] | None]:
        """Footprints by name, and the thing, its region and the other thing at which it failed, if it did."""
        placed: dict[str, _Placed] = {}
        for thing, region in self._on_table:
            entity = self.entities[thing]
            low_x, low_y, high_x, high_y = region.ranges[rng.integers(len(region.ranges))]
            center = self.origin + rng.uniform((low_x, low_y), (high_x, high_y))
            yaw = rng.uniform(*region.yaw) + CATEGORIES[self._category(thing)].yaw
            half = entity.footprint or (entity.radius, entity.radius)
            spot = _Placed(center, half, yaw, entity.footprint is None)
            fixed = thing in self.problem.fixtures
            for other, there in placed.items():
                # Fixtures stand where the file puts them: LIBERO does not check them against each other either.
                if not (fixed and other in self.problem.fixtures) and _overlap(spot, there):
                    return placed, (thing, region.name, other)
            placed[thing] = spot
        return placed, None

    def _set_pose(self, data: mujoco.MjData, name: str, position: tuple[float, float, float], yaw: float) -> None:
        body = self.model.body(f"{name}/")
        quat = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        mocap = self.model.body_mocapid[body.id]
        if mocap >= 0:
            data.mocap_pos[mocap], data.mocap_quat[mocap] = position, quat
        else:
            start = self.model.jnt_qposadr[body.jntadr[0]]
            data.qpos[start : start + 3] = np.add(position, (0, 0, DROP))
            data.qpos[start + 3 : start + 7] = quat

    def _set_carried(self, data: mujoco.MjData, thing: str, carrier: str, part: str, rng: np.random.Generator) -> None:
        entity = self.entities[thing]
        if not part:
            body = self.model.body(f"{carrier}/").id
            top = data.xpos[body] + (0.0, 0.0, self.entities[carrier].surface)
            self._set_pose(data, thing, tuple(top), 0.0)
            return
        site = self.model.site(f"{carrier}/{part}").id
        region = self.entities[carrier].regions[part]
        half = entity.footprint or (entity.radius, entity.radius)
        slack = np.maximum(np.array(region.half_size[:2]) - max(half), 0.0) * (1.0 if region.on_top else MIDDLE)
        bottom = 0.0 if region.on_top else -region.half_size[2]
        local = np.array([*(rng.uniform(-slack, slack)), bottom])
        position = data.site_xpos[site] + data.site_xmat[site].reshape(3, 3) @ local
        self._set_pose(data, thing, tuple(position), 0.0)


def _overlap(a: _Placed, b: _Placed) -> bool:
    """Whether two footprints come closer than :data:`GAP`: exact for circles and for rectangles among themselves, a
    circle beside a rectangle counts as the square around it."""
    between = b.center - a.center
    if a.round and b.round:
        return bool(np.hypot(*between) < a.half[0] + b.half[0] + GAP)
    axes = [np.array([math.cos(yaw), math.sin(yaw)]) for s in (a, b) for yaw in (s.yaw, s.yaw + math.pi / 2)]
    return all(abs(between @ axis) < _reach(a, axis) + _reach(b, axis) + GAP for axis in axes)


def _reach(spot: _Placed, axis: np.ndarray) -> float:
    """Half the footprint's width along a direction."""
    if spot.round:
        return spot.half[0]
    cos, sin = math.cos(spot.yaw), math.sin(spot.yaw)
    return float(abs(axis @ (cos, sin)) * spot.half[0] + abs(axis @ (-sin, cos)) * spot.half[1])
