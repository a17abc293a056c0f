"""Things are taken hold of the same way in most states of a task, and another way where something stands in it."""

from __future__ import annotations

import numpy as np
import pytest

from worldenv_trl.scenes import SceneBatch, load_task
from worldenv_trl.scenes.skills.grips import grips

BOWL, ROWS = "bowl_1", 50


def _scene(name: str, rows: int = ROWS) -> SceneBatch:
    task = load_task(name)
    scene = SceneBatch(task, rows, cameras=(), num_threads=1)
    scene.reset(np.arange(rows), task.init_states("train", rows))
    return scene


def _side(scene: SceneBatch) -> np.ndarray:
    """Direction from the bowl's middle to where it is taken, in whole quarter turns, ``[n]``."""
    point, yaw = grips(scene, scene.task, BOWL, scene.task.entities[BOWL].grasp)
    x, y = (point - scene.xpos[:, scene.model.body(f"{BOWL}/").id])[:, :2].T
    across = np.abs(np.stack([np.cos(yaw), np.sin(yaw)]) * np.stack([x, y])).sum(0)
    np.testing.assert_allclose(across, 0.0, atol=1e-9)  # one finger inside the rim, one outside
    return np.round(np.arctan2(y, x) / (np.pi / 2)).astype(int)


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("starter/put_the_bowl_on_the_plate", 1.0),
        ("spatial/pick_the_bowl_on_the_cookie_box", 1.0),
        ("goal/put_the_bowl_on_the_plate", 0.7),
        ("goal/open_the_top_drawer_and_put_the_bowl_inside", 0.65),
    ],
)
def test_a_bowl_is_taken_by_the_same_rim_in_most_states(name, share):
    counts = np.unique(_side(_scene(name)), return_counts=True)[1]
    assert counts.max() >= share * ROWS


def test_where_something_stands_at_the_usual_rim_the_bowl_is_taken_by_another_one():
    scene = _scene("goal/put_the_bowl_on_the_plate")
    _move(scene, "wine_bottle_1", np.full((ROWS, 2), 0.29))  # out of everybody's way
    before = _side(scene)
    usual = np.bincount(before % 4).argmax()
    rows = before % 4 == usual
    assert rows.sum() > 30
    outwards = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[usual]
    bowl = scene.xpos[:, scene.model.body(f"{BOWL}/").id, :2].copy()
    _move(scene, "wine_bottle_1", bowl + 0.08 * outwards)
    assert (_side(scene)[rows] % 4 != usual).all()
    _move(scene, "wine_bottle_1", bowl - 0.2 * outwards)
    assert (_side(scene)[rows] % 4 == usual).all()


def test_where_no_way_has_room_the_one_with_the_most_is_taken_and_always_the_same():
    """On the stove, every rim of the bowl is close to something."""
    side = _side(_scene("spatial/pick_the_bowl_on_the_stove"))
    assert len(np.unique(side)) == 1


def _move(scene: SceneBatch, thing: str, place: np.ndarray) -> None:
    joint = scene.model.body(f"{thing}/").jntadr[0]
    address = scene.model.jnt_qposadr[joint]
    scene.qpos[:, address : address + 2] = place
    scene.reset(np.arange(scene.num_envs), scene.sim_state())
