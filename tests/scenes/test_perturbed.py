"""Disturbed experts fail in the way they are asked to, and each row's mishaps are its own."""

from __future__ import annotations

import numpy as np
import pytest

from worldenv_trl.envs import ExpertPolicy, TabletopEnv
from worldenv_trl.scenes import PerturbedExpert, SceneBatch, ScriptedExpert, load_task

NAME = "object/put_the_soup_in_the_basket"


def play(expert, rows: int = 8, name: str = NAME):
    task = load_task(name)
    scene = SceneBatch(task, rows, cameras=(), num_threads=1)
    scene.reset(np.arange(rows), task.init_states("train", rows))
    actions, done = [], np.zeros(rows, bool)
    for _ in range(task.max_steps):
        actions.append(expert(scene))
        assert np.abs(actions[-1]).max() <= 1.0
        scene.step(actions[-1])
        done |= scene.success()
    return scene, np.stack(actions), done


def test_nothing_disturbed_is_the_expert_itself():
    task = load_task(NAME)
    plain, disturbed = play(ScriptedExpert(task)), play(PerturbedExpert(task))
    assert np.array_equal(plain[1], disturbed[1]) and plain[2].all()


def test_an_early_release_drops_the_thing_short_of_its_place():
    scene, actions, done = play(PerturbedExpert(load_task(NAME), early_release=1.0))
    assert not done.any()
    assert (actions[-1, :, 6] == -1).all() and (actions[-1, :, :6] == 0).all()
    thing = scene.model.body("soup_1/").id
    now = scene.xpos[:, thing].copy()
    scene.reset(np.arange(8), load_task(NAME).init_states("train", 8))
    highest = scene.xpos[:, thing, 2].copy()
    for action in actions:
        scene.step(action)
        highest = np.maximum(highest, scene.xpos[:, thing, 2])
    assert (highest > 0.01).all() and (now[:, 2] < 0.03).all()  # it was lifted, and lies below again


def test_the_wrong_thing_ends_in_the_basket():
    task = load_task(NAME)
    scene, _, done = play(PerturbedExpert(task, wrong_object=1.0))
    assert not done.any()
    inside = [
        task.relations.evaluate(scene, "In", name, "basket_1_contain_region").mean()
        for name in task.entities
        if name not in ("soup_1", "basket_1")
    ]
    assert max(inside) > 0.8


def test_flips_of_the_gripper_and_noise_do_harm_and_a_seed_repeats_them():
    task = load_task(NAME)
    options = {"noise": 0.1, "gripper_flips": 0.1}
    first, again = (play(PerturbedExpert(task, **options, seed=3)) for _ in range(2))
    assert np.array_equal(first[1], again[1])
    other = play(PerturbedExpert(task, **options, seed=4))
    assert not np.array_equal(first[1], other[1])
    alone = play(PerturbedExpert(task, **options, seed=3), rows=1)
    assert np.array_equal(alone[1][:, 0], first[1][:, 0])


def test_a_reset_draws_other_mishaps():
    task = load_task(NAME)
    expert = PerturbedExpert(task, noise=0.1)
    scene = SceneBatch(task, 2, cameras=(), num_threads=1)
    states = task.init_states("train", 2)
    scene.reset(np.arange(2), states)
    before = expert(scene)
    expert.reset(np.array([1]))
    after = expert(scene)
    assert not np.array_equal(before[1], after[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"early_release": 1.5}, "early_release is a probability, got 1.5: pass a number from 0 to 1"),
        ({"gripper_flips": float("nan")}, "gripper_flips is a probability, got nan"),
        ({"wrong_object": -0.1}, "wrong_object is a probability, got -0.1"),
        ({"early_release": "yes"}, "early_release is a probability, got 'yes'"),
        ({"noise": -1.0}, "noise must be a finite number and not negative, got -1.0"),
        ({"noise": float("nan")}, "noise must be a finite number and not negative, got nan"),
        ({"noise": None}, "noise must be a finite number and not negative, got None"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"seed": 1.5}, "seed must be a whole number of at least 0, got 1.5"),
    ],
)
def test_impossible_settings_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        PerturbedExpert(load_task(NAME), **options)


def test_a_scene_without_another_thing_has_no_wrong_one():
    with pytest.raises(ValueError, match="wrong_object must be 0"):
        PerturbedExpert(load_task("starter/turn_on_the_stove"), wrong_object=0.5)


def test_it_acts_in_an_environment_in_the_expert_s_place():
    env = TabletopEnv(NAME, 4, cameras=(), max_steps=60, seed=0)
    policy = ExpertPolicy(env, lambda task: PerturbedExpert(task, early_release=1.0))
    rollout = env.rollout(60, policy)
    assert rollout.shape[0] == 4 and not rollout["next", "success"].any()
