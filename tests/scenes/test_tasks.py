"""The task catalogue: names, scenes, and initial states that are settled, reproducible and inside the picture."""

from __future__ import annotations

import numpy as np
import pytest

from worldenv_trl.scenes import SceneBatch, list_suites, list_tasks, load_task
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.initial import draw_poses, states_from_poses

NAMES = list_tasks("starter")
BOWL = "starter/put_the_bowl_on_the_plate"


def _scene(name: str, states: np.ndarray, **options) -> SceneBatch:
    scene = SceneBatch(load_task(name), len(states), **({"cameras": (), "num_threads": 1} | options))
    scene.reset(np.arange(len(states)), states)
    return scene


def started(task):
    """Each thing on the table, and the region that it starts in."""
    return [(thing, task.problem.regions[place]) for _, thing, place in task.problem.init]


def test_the_starter_tasks_stand_beside_the_suites():
    assert "starter" not in list_suites()
    assert NAMES == ["starter/open_the_top_drawer", BOWL, "starter/turn_on_the_stove"]
    loaded = [load_task(name) for name in NAMES]
    assert [task.name for task in loaded] == NAMES
    assert all(task.suite == "starter" and task.max_steps == 72 and task.language for task in loaded)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: load_task("starter/turn_on_the_stve"), "did you mean 'starter/turn_on_the_stove'"),
        (lambda: load_task("goal"), "'goal' is a suite: name tasks of it, for instance 'goal/open_the_middle_drawer'"),
        (lambda: load_task("???"), "suite/name, suites are starter, spatial, object, goal, long"),
        (lambda: list_tasks("gaol"), "unknown suite 'gaol': it must be one of spatial, object, goal, long, starter"),
        (lambda: load_task(BOWL).init_states("validation"), "'validation': it must be 'train' or 'test'"),
        (lambda: load_task(BOWL).init_states("train", 0), "count must be at least 1, got 0"),
        (lambda: load_task(BOWL).init_states("train", 10**9), "count must be at most 50000, got 1000000000"),
        (lambda: load_task(BOWL).camera("sideview"), f"unknown camera 'sideview': {BOWL} has agentview, wrist"),
    ],
)
def test_a_wrong_name_or_number_is_named_with_the_remedy(call, message):
    with pytest.raises(ValueError, match=message.replace("?", r"\?")):
        call()


@pytest.mark.parametrize("name", NAMES)
def test_a_longer_list_of_initial_states_extends_a_shorter_one(name):
    task = load_task(name)
    longer, shorter = task.init_states("train", 12), task.init_states("train", 5)
    assert longer.dtype == np.float64
    assert np.array_equal(longer[:5], shorter)


@pytest.mark.parametrize("name", NAMES)
def test_initial_states_are_the_same_when_drawn_again_and_may_be_written_to(name):
    task = load_task(name)
    first = task.init_states("test", 4)
    changed = task.init_states("test", 4)
    changed[:] = 0.0
    assert np.array_equal(task.init_states("test", 4), first)
    assert np.array_equal(states_from_poses(task, draw_poses(task, "test", 0, 4)), first)


@pytest.mark.parametrize("name", NAMES)
def test_no_initial_state_is_in_both_splits_or_twice_in_one(name):
    task = load_task(name)
    states = np.concatenate([task.init_states("train", 40), task.init_states("test", 40)])
    distance = np.abs(states[:, None] - states[None]).max(-1) + np.eye(80)
    assert distance.min() > 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_initial_states_are_unsolved_and_rest_while_nothing_is_done(name):
    states = load_task(name).init_states("test", 20)
    scene = _scene(name, states)
    before = scene.xpos.copy()
    assert not scene.success().any()
    for _ in range(20):
        scene.step(np.zeros((20, 7)))
    assert np.abs(scene.xpos - before).max() < 1e-4
    assert not scene.success().any()


@pytest.mark.parametrize("name", NAMES)
def test_things_start_inside_their_rectangles_and_use_most_of_them(name):
    task = load_task(name)
    scene = _scene(name, task.init_states("train", 60))
    for thing, region in started(task):
        low, high = np.array(region.ranges[0]).reshape(2, 2)
        place = scene.xpos[:, scene.model.body(f"{thing}/").id, :2]
        assert (place > low - 0.001).all() and (place < high + 0.001).all()
        assert (np.ptp(place, axis=0) > 0.75 * (high - low)).all()


def test_the_bowl_never_starts_against_the_plate():
    scene = _scene(BOWL, load_task(BOWL).init_states("test", 60))
    bowl, plate = (scene.xpos[:, scene.model.body(f"{name}/").id, :2] for name in ("bowl_1", "plate_1"))
    assert np.linalg.norm(bowl - plate, axis=-1).min() > 0.15


@pytest.mark.parametrize("name", NAMES)
def test_the_middle_of_everything_is_inside_the_picture(name):
    task = load_task(name)
    scene = _scene(name, task.init_states("test", 60))
    for thing, _ in started(task):
        place = scene.xpos[:, scene.model.body(f"{thing}/").id]
        pixels = task.camera("agentview").project(place, 64)
        assert pixels.min() > 8 and pixels.max() < 56


def test_the_camera_spends_a_pixel_on_nine_millimetres_or_less_across_the_scene():
    camera = load_task(BOWL).camera("agentview")
    left, right = camera.project(np.array([[0.0, -0.1, 0.05], [0.0, 0.1, 0.05]]), 64)
    assert 200 / np.linalg.norm(right - left) < 9.0


def test_the_model_is_compiled_once_and_holds_only_what_its_task_needs():
    stove = load_task("starter/turn_on_the_stove")
    assert stove.build() is stove.build()
    names = {stove.build().body(index).name for index in range(stove.build().nbody)}
    assert "stove_1/" in names and "bowl_1/" not in names and "cabinet_1/" not in names


def test_the_burner_is_drawn_red_exactly_while_the_lever_is_on():
    name = "starter/turn_on_the_stove"
    states = np.repeat(load_task(name).init_states("train", 1), 3, axis=0)
    scene = _scene(name, states, cameras=("agentview",))
    lever = scene.model.jnt_qposadr[scene.model.joint("stove_1/lever").id]
    scene.qpos[:, lever] = [0.0, Stove.ON_ABOVE - 0.01, Stove.ON_ABOVE + 0.01]
    images = scene.render()["agentview"].astype(int)
    red = (images[:, 0] > 180) & (images[:, 1] < 80) & (images[:, 2] < 80)
    assert red[0].sum() == red[1].sum() == 0
    assert red[2].sum() > 60  # px of 64 x 64
