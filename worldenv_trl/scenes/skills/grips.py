"""Where to take hold of a thing, and how the hand is turned there."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.robot import panda
from worldenv_trl.scenes.entities.base import Grasp
from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.initial import drawn_scene
from worldenv_trl.scenes.skills.clearance import room
from worldenv_trl.scenes.skills.phase import axes, body, half_turn

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

Grips = tuple[np.ndarray, np.ndarray]
"""Where ``[n, 3]`` (m), and the hand's yaw ``[n]`` (rad)."""

_REACH = 0.78  # from the base, m; a hand that points down reaches little further
_ENOUGH = -0.005  # m of room: nothing is as square as its box; from 6 mm inside on the hand had to come again
_DRAWS = 64
_TURN = 0.2  # a way that turns the hand takes longer and sweeps more: it is usual where so many more layouts allow it


def grips(scene: SceneBatch, task: FileTask, thing: str, grasp: Grasp) -> Grips:
    """How to grip ``thing`` in each row: the usual way of its task where there is room, else the next usual one.

    Where no way has room it is the one with the most. So two demonstrations of a task take a bowl by the same rim,
    unless something stands there, and teach the same.

    Raises:
        RuntimeError: if the task's things cannot be placed clear of each other.
    """
    ways = _ways(scene, thing, grasp)
    chosen, rows = _chosen(scene, task, thing, grasp, ways), np.arange(scene.num_envs)
    points, yaws = np.stack([way[0] for way in ways]), np.stack([way[1] for way in ways])
    return points[chosen, rows], yaws[chosen, rows]


def way_taken(scene: SceneBatch, task: FileTask, thing: str, grasp: Grasp) -> np.ndarray:
    """Which way :func:`grips` takes ``thing`` in each row: int ``[n]``, a number of the way among those that it has."""
    return _chosen(scene, task, thing, grasp, _ways(scene, thing, grasp))


def _chosen(scene: SceneBatch, task: FileTask, thing: str, grasp: Grasp, ways: list[Grips]) -> np.ndarray:
    if len(ways) == 1:
        return np.zeros(scene.num_envs, int)
    rooms = _rooms(scene, task, thing, grasp, ways)
    order = list(_usual(task, thing, grasp))
    enough = rooms[order] > _ENOUGH
    return np.where(enough.any(0), np.array(order)[enough.argmax(0)], rooms.argmax(0))


@cache
def _usual(task: FileTask, thing: str, grasp: Grasp) -> tuple[int, ...]:
    """The ways, the one first that has room in most of the layouts that the task draws; of equal ones the simplest."""
    scene = drawn_scene(task, _DRAWS)
    ways = _ways(scene, thing, grasp)
    share = (_rooms(scene, task, thing, grasp, ways) > _ENOUGH).mean(1)
    turned = np.array([np.abs(yaw - ways[0][1]).max() > 0.1 for _, yaw in ways])
    return tuple(np.argsort(_TURN * turned - share, kind="stable").tolist())


def _ways(scene: SceneBatch, thing: str, grasp: Grasp) -> list[Grips]:
    """Ways to grip a thing, the simplest first."""
    origin, turned = body(scene, thing), axes(scene, thing)
    x, y, z = grasp.offset
    heading = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    level = np.zeros_like(heading)
    if grasp.kind == "rim":
        offsets = ((0.0, y, 0.0), (0.0, -y, 0.0), (-y, 0.0, 0.0), (y, 0.0, 0.0))
        yaws = (level, level, level + np.pi / 2, level + np.pi / 2)
        return [(origin + np.add(offset, (0, 0, z)), yaw) for offset, yaw in zip(offsets, yaws, strict=True)]
    point = origin + turned @ np.array((x, y, 0.0)) + (0.0, 0.0, z)
    if grasp.kind == "round":
        return [(point, level + yaw) for yaw in (0.0, np.pi / 4, -np.pi / 4, np.pi / 2)]
    if grasp.kind == "square":
        return [(point, half_turn(heading)), (point, half_turn(heading + np.pi / 2))]
    return [(point, half_turn(heading))]


def _rooms(scene: SceneBatch, task: FileTask, thing: str, grasp: Grasp, ways: list[Grips]) -> np.ndarray:
    """``[ways, n]`` metres around the hand, less what it would have to reach too far."""
    rooms = []
    for point, yaw in ways:
        direction = np.stack([-np.sin(yaw), np.cos(yaw)], -1)
        if grasp.kind == "rim":  # the outer finger is the one that needs room
            direction = (point - body(scene, thing))[:, :2] / grasp.offset[1]
        far = np.linalg.norm(point[:, :2] - panda.BASE_POSITION[:2], axis=-1) - _REACH
        rooms.append(room(scene, task.entities, point, direction, (thing,)) - np.maximum(far, 0.0))
    return np.stack(rooms)
