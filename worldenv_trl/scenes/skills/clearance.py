"""What stands in the way: how high the hand must go, and from which side it may reach down."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.robot import panda
from worldenv_trl.scenes.entities import Primitive
from worldenv_trl.scenes.skills.phase import FINGER_HALF, FINGERTIP, axes, body, tcp

if TYPE_CHECKING:
    from worldenv_trl.scenes.files import FileTask
    from worldenv_trl.scenes.simulation import SceneBatch

MARGIN = 0.025  # between what moves and what it moves over
_HAND = 0.08  # kept free on both sides of the hand's path
_PALM_ABOVE = 0.037  # underside of the palm over the point between the fingertips
_PALM_HALF = 0.022  # half its thickness
# Points that must be free, along the fingers' axis and across it, [k, 2].
_FINGERS = np.array(list(product((0.0, 0.03, 0.055), (-FINGER_HALF, 0.0, FINGER_HALF))))
_PALM = np.array(list(product((-0.10, -0.05, 0.05, 0.10), (-_PALM_HALF, 0.0, _PALM_HALF))))
_CEILING = panda.WORKSPACE_HIGH[2] - 0.01
_RISE, _THERE = 0.02, 0.02  # sideways only this near to the height that it takes; down only this near to the end
_FREE = 0.02  # more room than this is as good as this


def travel(
    scene: SceneBatch,
    task: FileTask,
    end: np.ndarray,
    without: Collection[str] = (),
    hanging: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Where the hand goes next on its way to ``end [n, 3]``: up first, where something stands in the way.

    ``hanging`` is how far what it carries reaches down below it; things ``without`` are in nobody's way.
    """
    now = tcp(scene)
    needed = height_over(scene, task.entities, now, end, without) + MARGIN + hanging
    needed = np.minimum(np.maximum(needed, end[:, 2]), _CEILING)
    share = np.clip((now[:, 2] - needed) / _RISE + 1.0, 0.0, 1.0)[:, None]
    near = np.linalg.norm((end - now)[:, :2], axis=-1) < _THERE
    target = now + share * (end - now)
    target[:, 2] = np.where(near, end[:, 2], needed)
    return target


def height_over(
    scene: SceneBatch,
    entities: Mapping[str, Primitive],
    start: np.ndarray,
    end: np.ndarray,
    without: Collection[str] = (),
) -> np.ndarray:
    """``[n]`` height of the highest thing near the straight way from ``start`` to ``end`` (``[n, 3]``)."""
    way = (end - start)[:, :2]
    length = np.maximum((way**2).sum(-1), 1e-9)
    highest = np.zeros(len(start))
    for center, _, half, top in _obstacles(scene, entities, without):
        along = np.clip(((center - start)[:, :2] * way).sum(-1) / length, 0.0, 1.0)
        nearest = start[:, :2] + along[:, None] * way
        near = np.linalg.norm(center[:, :2] - nearest, axis=-1) < _HAND + np.hypot(*half[:2])
        highest = np.where(near, np.maximum(highest, top), highest)
    return highest


def room(
    scene: SceneBatch,
    entities: Mapping[str, Primitive],
    grip: np.ndarray,
    direction: np.ndarray,
    without: Collection[str],
) -> np.ndarray:
    """``[n]`` metres around a hand at ``grip [n, 3]`` whose fingers open along ``direction [n, 2]``, at most 2 cm."""
    free = np.full(len(grip), _FREE)
    hand = np.stack([direction, np.stack([-direction[:, 1], direction[:, 0]], -1)], 1)  # its axes, [n, 2, 2]
    for center, turned, half, top in _obstacles(scene, entities, without):
        inwards = hand @ turned[:, :2, :2]
        middle = np.einsum("nji,nj->ni", turned[:, :2, :2], grip[:, :2] - center[:, :2])
        for points, rise in ((_FINGERS, -FINGERTIP), (_PALM, _PALM_ABOVE)):
            local = np.abs(middle[:, None] + points @ inwards) - half[:2]  # [n, k, 2]
            gap = np.linalg.norm(np.maximum(local, 0.0), axis=-1) + np.minimum(local.max(-1), 0.0)
            free = np.where(top > grip[:, 2] + rise, np.minimum(free, gap.min(-1)), free)
    return free


def _obstacles(
    scene: SceneBatch, entities: Mapping[str, Primitive], without: Collection[str]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Centre ``[n, 3]``, axes ``[n, 3, 3]``, half size and upper end ``[n]`` of every box that stands in the way."""
    for name, entity in entities.items():
        if name in without:
            continue
        center = body(scene, name)
        half = entity.footprint or (0.8 * entity.radius, 0.8 * entity.radius)  # round ones: about their inner square
        yield center, axes(scene, name), np.array(half), center[:, 2] + entity.height
        for jut, size in entity.juts.items():
            site = scene.model.site(f"{name}/{jut}").id
            center = scene.site_xpos[:, site]
            yield center, scene.site_xmat[:, site].reshape(-1, 3, 3), np.array(size), center[:, 2] + size[2]
