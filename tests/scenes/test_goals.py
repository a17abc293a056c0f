"""Goal predicates against hand-placed states and against LIBERO's own formula on MuJoCo's contacts."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from worldenv_trl.scenes import SceneBatch, ScriptedExpert, load_task
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Plate

BOWL, DRAWER, STOVE = "starter/put_the_bowl_on_the_plate", "starter/open_the_top_drawer", "starter/turn_on_the_stove"


def _scene(name: str, rows: int) -> SceneBatch:
    scene = SceneBatch(load_task(name), rows, cameras=(), num_threads=1)
    scene.reset(np.arange(rows), np.repeat(load_task(name).init_states("train", 1), rows, axis=0))
    return scene


def _current(scene: SceneBatch) -> SceneBatch:
    scene.reset(np.arange(scene.num_envs), scene.sim_state())
    return scene


def _address(scene: SceneBatch, body: str) -> int:
    return scene.model.jnt_qposadr[scene.model.body_jntadr[scene.model.body(body).id]]


def _bowl_at(offsets, tilts=None) -> SceneBatch:
    """The bowl's bottom placed at ``offsets [n, 3]`` from the middle of the plate's top, tilted about x (rad)."""
    offsets = np.asarray(offsets, float)
    scene = _scene(BOWL, len(offsets))
    bowl, plate = _address(scene, "bowl_1/"), _address(scene, "plate_1/")
    scene.qpos[:, bowl : bowl + 3] = scene.qpos[:, plate : plate + 3] + offsets + (0, 0, Plate.TOP)
    half = np.zeros(len(offsets)) if tilts is None else np.asarray(tilts) / 2
    scene.qpos[:, bowl + 3 : bowl + 7] = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], -1)
    return _current(scene)


def _holds(scene: SceneBatch, predicate: str, *arguments: str) -> np.ndarray:
    return scene.task.relations.evaluate(scene, predicate, *arguments)


def _on(scene: SceneBatch) -> np.ndarray:
    return _holds(scene, "On", "bowl_1", "plate_1")


def test_a_bowl_is_on_the_plate_within_three_centimetres_of_its_middle():
    distances = [0.0, 0.029, 0.031, 0.06]
    scene = _bowl_at([(d * math.cos(0.7), d * math.sin(0.7), -0.0002) for d in distances])
    assert _on(scene).tolist() == [True, True, False, False]


def test_a_bowl_held_above_the_plate_is_not_on_it():
    scene = _bowl_at([(0, 0, -0.0002), (0, 0, 0.002), (0, 0, 0.05)])
    assert _on(scene).tolist() == [True, False, False]


def test_a_bowl_held_askew_with_an_edge_on_the_plate_is_on_it_as_in_libero():
    edge = [(0, 0, 0.054 * math.sin(tilt) - 0.0002) for tilt in (0.1, 0.3)]  # 0.054 m: radius of the foot
    assert _on(_bowl_at(edge, [0.1, 0.3])).all()


def test_a_bowl_on_the_table_beside_the_plate_is_not_on_it():
    scene = _bowl_at([(0.0, 0.15, -Plate.TOP)])
    assert not _on(scene).any()


def _libero_on(scene: SceneBatch) -> np.ndarray:
    """LIBERO's On: the plate is not above the bowl, they touch, and their centres are within 3 cm horizontally."""
    model, data = scene.model, mujoco.MjData(scene.model)
    bodies = model.body("bowl_1/").id, model.body("plate_1/").id
    result = []
    for qpos in scene.qpos:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        pairs = {frozenset(model.geom_bodyid[contact.geom].tolist()) for contact in data.contact}
        bowl, plate = data.xpos[bodies[0]], data.xpos[bodies[1]]
        near = np.hypot(*(bowl - plate)[:2]) < 0.03
        result.append(bool(frozenset(bodies) in pairs and near and plate[2] <= bowl[2]))
    return np.array(result)


def test_on_agrees_with_liberos_contact_test_for_bowls_dropped_around_the_plate():
    rng = np.random.default_rng(3)
    offsets = np.concatenate([rng.uniform(-0.035, 0.035, (40, 2)), np.full((40, 1), 0.004)], -1)
    scene = _bowl_at(offsets)
    for _ in range(20):
        scene.step(np.zeros((40, 7)))
    expected = _libero_on(scene)
    assert 5 < expected.sum() < 35
    assert np.array_equal(_on(scene), expected)


def test_on_is_liberos_in_every_step_of_an_experts_episode():
    task = load_task(BOWL)
    scene = SceneBatch(task, 6, cameras=(), num_threads=1)
    scene.reset(np.arange(6), task.init_states("train", 6))
    expert, seen = ScriptedExpert(task), 0
    for _ in range(70):
        scene.step(expert(scene))
        assert np.array_equal(_on(scene), _libero_on(scene))
        seen += int(_on(scene).sum())
    assert seen > 90


def test_a_drawer_is_open_past_liberos_threshold_and_only_the_named_one_counts():
    scene = _scene(DRAWER, 4)
    for row, (drawer, travel) in enumerate([("top", -0.139), ("top", -0.141), ("middle", -0.15), ("bottom", -0.15)]):
        scene.qpos[row, scene.model.jnt_qposadr[scene.model.joint(f"cabinet_1/{drawer}").id]] = travel
    assert Cabinet.OPEN_BELOW == -0.14
    assert _holds(scene, "Open", "cabinet_1_top_region").tolist() == [False, True, False, False]
    assert _holds(scene, "Open", "cabinet_1_middle_region").tolist() == [False, False, True, False]
    assert scene.success().tolist() == [False, True, False, False]


def test_the_stove_is_on_once_its_lever_has_swung_sixty_degrees():
    scene = _scene(STOVE, 3)
    lever = scene.model.jnt_qposadr[scene.model.joint("stove_1/lever").id]
    scene.qpos[:, lever] = [0.0, Stove.ON_ABOVE - 0.001, Stove.ON_ABOVE + 0.001]
    assert math.degrees(Stove.ON_ABOVE) > 60
    assert _holds(scene, "TurnOn", "stove_1").tolist() == [False, False, True]
    assert scene.success().tolist() == [False, False, True]


@pytest.mark.parametrize("name", [BOWL, DRAWER, STOVE])
def test_success_is_judged_on_the_state_after_the_step(name):
    task = load_task(name)
    scene = SceneBatch(task, 3, cameras=(), num_threads=1)
    scene.reset(np.arange(3), task.init_states("train", 3))
    expert = ScriptedExpert(task)
    while not scene.success().all():
        scene.step(expert(scene))
        stored = scene.success()
        assert np.array_equal(_current(scene).success(), stored)
