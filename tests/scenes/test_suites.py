"""The four suites: forty tasks that read, rest, stay clear of each other, and are solved by the expert."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from worldenv_trl.policies import OFTConfig
from worldenv_trl.scenes import SceneBatch, ScriptedExpert, list_suites, list_tasks, load_task
from worldenv_trl.scenes.initial import draw_poses, load_poses, save_poses, states_from_poses

NAMES = [name for suite in list_suites() for name in list_tasks(suite)]


def scene_of(name: str, states: np.ndarray) -> SceneBatch:
    scene = SceneBatch(load_task(name), len(states), cameras=(), num_threads=1)
    scene.reset(np.arange(len(states)), states)
    return scene


def test_there_are_four_suites_of_ten_tasks_each_with_words_and_a_digest_of_its_own():
    assert list_suites() == ["spatial", "object", "goal", "long"]
    tasks = [load_task(name) for name in NAMES]
    assert [len(list_tasks(suite)) for suite in list_suites()] == [10] * 4
    assert [task.name for task in tasks] == NAMES
    assert len({task.digest for task in tasks}) == len({task.language for task in tasks}) == 40
    assert max(len(task.language.split()) for task in tasks) <= OFTConfig.max_words
    assert all(task.name.startswith(f"{task.suite}/") for task in tasks)
    assert {task.language.split()[0] for task in tasks} >= {"put", "place", "pick", "open", "turn", "push", "take"}


def test_each_suite_varies_what_it_is_named_after():
    goals = {suite: [load_task(name).goal for name in list_tasks(suite)] for suite in list_suites()}
    assert len(set(goals["spatial"])) == 1  # the same goal, ten places where the bowl stands
    assert len({goal[0][1] for goal in goals["object"]}) == 10 and len({goal[0][2] for goal in goals["object"]}) == 1
    assert len(set(goals["goal"])) == 10
    things = [set(load_task(name).entities) for name in list_tasks("goal")]
    assert all(names == things[0] for names in things)  # one scene
    stages = [load_task(name) for name in list_tasks("long")]
    assert all(len(set(task.goal) - set(task.problem.init)) == 2 for task in stages)


@pytest.mark.parametrize("name", NAMES)
def test_initial_states_are_distinct_unsolved_at_rest_and_free_of_collisions(name):
    task = load_task(name)
    states = np.concatenate([task.init_states("train"), task.init_states("test")])
    assert len(states) == 100
    distance = np.abs(states[:, None] - states[None]).max(-1) + np.eye(100)
    assert distance.min() > 1e-4
    scene = scene_of(name, states)
    assert not scene.success().any()
    data, deepest = mujoco.MjData(scene.model), 0.0
    for row in range(0, 100, 10):
        scene.load(data, row)
        mujoco.mj_forward(scene.model, data)
        deepest = max(deepest, -data.contact.dist.min(initial=0.0))
    assert deepest < 2e-3
    before = scene.xpos.copy()
    for _ in range(5):
        scene.step(np.zeros((100, 7)))
    assert np.abs(scene.xpos - before).max() < 3e-3


@pytest.mark.parametrize("name", NAMES[::13])
def test_stored_states_are_what_the_seed_draws_and_more_extend_them(name):
    task = load_task(name)
    stored = load_poses(task, task.states)
    np.testing.assert_allclose(draw_poses(task, "test", 0, 3), stored["test"][:3], atol=1e-5)
    more = task.init_states("train", 52)
    assert np.array_equal(more[:50], task.init_states("train"))
    assert np.array_equal(more[50:], states_from_poses(task, draw_poses(task, "train", 50, 2)))


def test_a_state_that_the_check_refuses_is_drawn_again_and_no_other(tmp_path):
    task, path = load_task(NAMES[0]), tmp_path / "states.npz"
    assert not any(refusals.any() for refusals in save_poses(task, path, 4).values())
    before, bytes_before = load_poses(task, path), path.read_bytes()
    unwanted = states_from_poses(task, before["train"][2:3])
    redrawn = save_poses(task, path, 4, lambda states: (states != unwanted).any(-1))
    assert redrawn["train"].tolist() == [0, 0, 1, 0] and not redrawn["test"].any()
    after = load_poses(task, path)
    assert np.array_equal(after["test"], before["test"])
    assert (after["train"] != before["train"]).any(-1).tolist() == [False, False, True, False]
    save_poses(task, path, 4, lambda states: np.ones(len(states), bool))
    assert path.read_bytes() == bytes_before
    with pytest.raises(RuntimeError, match=rf"{task.name}: train initial state 2 is not solved in any of 10 draws"):
        save_poses(task, path, 4, lambda states: np.arange(len(states)) != (2 if len(states) == 4 else 0))
    assert path.read_bytes() == bytes_before


def test_states_of_another_version_of_a_file_are_refused():
    task = dataclasses.replace(load_task(NAMES[0]), digest="0" * 64)
    with pytest.raises(RuntimeError, match=r"another version of spatial/.*init_states.py"):
        task.init_states("train")


@pytest.mark.parametrize("name", NAMES)
def test_the_expert_solves_states_of_both_splits(name):
    task = load_task(name)
    states = np.concatenate([task.init_states("train", 2), task.init_states("test", 2)])
    scene, expert, done = scene_of(name, states), ScriptedExpert(task), np.zeros(4, bool)
    for _ in range(task.max_steps):
        action = expert(scene)
        assert np.abs(action).max() <= 1.0
        scene.step(action, active=~done)
        done |= scene.success()
        if done.all():
            break
    assert done.all()
