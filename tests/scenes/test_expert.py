"""The scripted expert solves its tasks, corrects disturbances and acts on each row alone."""

from __future__ import annotations

import dataclasses
import re
import warnings

import numpy as np
import pytest

from worldenv_trl.scenes import SceneBatch, ScriptedExpert, list_tasks, load_task

NAMES = list_tasks("starter")
BOWL = "starter/put_the_bowl_on_the_plate"


def _scene(name: str, rows: int, split: str = "train", skip: int = 0) -> SceneBatch:
    task = load_task(name)
    scene = SceneBatch(task, rows, cameras=(), num_threads=1)
    scene.reset(np.arange(rows), task.init_states(split, rows + skip)[skip:])
    return scene


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("name", NAMES)
def test_the_expert_solves_every_initial_state_well_before_the_limit(name, split):
    scene = _scene(name, 30, split)
    expert, done = ScriptedExpert(scene.task), np.zeros(30, bool)
    for _ in range(scene.task.max_steps - 10):
        action = expert(scene)
        assert action.shape == (30, 7) and np.abs(action).max() <= 1.0
        scene.step(action)
        done |= scene.success()
    assert done.all()


@pytest.mark.parametrize("name", NAMES)
def test_what_the_expert_has_finished_lasts(name):
    scene = _scene(name, 30)
    expert = ScriptedExpert(scene.task)
    for _ in range(scene.task.max_steps):
        scene.step(expert(scene))
    for _ in range(20):
        scene.step(np.zeros((30, 7)))
        assert scene.success().all()


@pytest.mark.parametrize("name", NAMES)
def test_small_noise_on_its_actions_is_corrected(name):
    scene, rng = _scene(name, 30), np.random.default_rng(1)
    expert, done = ScriptedExpert(scene.task), np.zeros(30, bool)
    for _ in range(scene.task.max_steps):
        noise = rng.normal(0.0, 0.05, (30, 7))
        scene.step(np.clip(expert(scene) + noise, -1, 1))
        done |= scene.success()
    assert done.mean() > 0.9


def test_a_dropped_bowl_is_taken_again():
    scene = _scene(BOWL, 10)
    expert, done = ScriptedExpert(scene.task), np.zeros(10, bool)
    bowl = scene.model.body("bowl_1/").id
    for step in range(110):
        action = expert(scene)
        if 33 <= step < 38:
            action[:, 6] = -1.0
        scene.step(action)
        if step == 32:
            assert scene.xpos[:, bowl, 2].min() > 0.05  # in the air
        done |= scene.success()
    assert done.all()


@pytest.mark.parametrize("name", NAMES)
def test_a_row_is_acted_on_as_if_it_were_alone(name):
    many, alone = _scene(name, 4), _scene(name, 1, skip=2)
    crowd, single = ScriptedExpert(many.task), ScriptedExpert(alone.task)
    for _ in range(30):
        action = crowd(many)
        np.testing.assert_array_equal(single(alone)[0], action[2])
        many.step(action)
        alone.step(action[2:3])


def test_a_reset_row_starts_again_and_leaves_the_others_alone():
    scene = _scene(BOWL, 3)
    task, start = scene.task, scene.sim_state()
    expert = ScriptedExpert(task)
    first = [expert(scene)]
    for _ in range(29):
        scene.step(first[-1])
        first.append(expert(scene))
    expert.reset(np.array([1]))
    scene.step(first[-1])
    scene.reset(np.array([1]), start[1:2])
    for step in range(10):
        action = expert(scene)
        np.testing.assert_array_equal(action[1], first[step][1])
        scene.step(action)
    while not scene.success()[[0, 2]].all():
        scene.step(expert(scene))


def test_a_goal_without_a_script_is_refused_by_name():
    task = dataclasses.replace(load_task(BOWL), name="goal/stack", goal=(("Under", "bowl_1", "plate_1"),))
    with pytest.raises(ValueError, match="no script for goal/stack: no skill brings about Under"):
        ScriptedExpert(task)


@pytest.mark.parametrize(
    ("goal", "error", "message"),
    [
        (
            [("On", "bowl_2", "plate_1")],
            ValueError,
            rf"no script for {BOWL}: it has no thing or region 'bowl_2': did .*'bowl_1'",
        ),
        ([("On", "bowl_1", "plat_1")], ValueError, "no thing or region 'plat_1': did you mean 'plate_1'"),
        ([("Open", "nope")], ValueError, "no thing or region 'nope'; known are table_1, bowl_1, plate_1, table_1_"),
        ([("Onn", "bowl_1", "plate_1")], ValueError, "no skill brings about Onn: did you mean 'On'"),
        ([("turnon", "bowl_1")], ValueError, "no skill brings about turnon: did you mean 'TurnOn'"),
        ([("On", "bowl_1")], ValueError, r"On takes 2 name\(s\), got \('On', 'bowl_1'\)"),
        ([("In", "bowl_1", "plate_1")], ValueError, r"\(In bowl_1 plate_1\): plate_1 has no contain_region"),
        ([("On", "bowl_1", "bowl_1")], ValueError, "bowl_1 cannot be put on or into itself"),
        ([("On", "bowl_1", "table_1")], ValueError, "table_1 is the workspace: name one of its regions"),
        ([], ValueError, "its goal is empty"),
        (("On", "bowl_1", "plate_1"), TypeError, "a goal's predicate is a tuple of words, .* got 'On'"),
        ("On bowl_1 plate_1", TypeError, "goal must be a sequence of predicates such as .* got 'On bowl_1 plate_1'"),
    ],
)
def test_a_goal_that_cannot_be_asked_is_refused_with_what_is_close(goal, error, message):
    with pytest.raises(error, match=message):
        ScriptedExpert(BOWL, goal=goal)


@pytest.mark.parametrize(
    ("task", "error", "message"),
    [
        ("starter/put_the_bwl", ValueError, f"did you mean '{BOWL}'"),
        (None, TypeError, "a task is called by its name or file, got None"),
        ([BOWL], TypeError, r"got \['starter/put_the_bowl_on_the_plate'\]"),
    ],
)
def test_a_task_that_is_none_is_refused(task, error, message):
    with pytest.raises(error, match=message):
        ScriptedExpert(task)


def test_before_a_lever_at_the_bounds_of_the_workspace_the_hand_does_not_wait():
    # a policy that sees only now cannot learn when to go on from a place where nothing changes
    scene = _scene("goal/turn_on_the_stove", 20)
    expert, done, resting = ScriptedExpert(scene.task), np.zeros(20, bool), np.zeros(20, int)
    before = scene.measured_state()[:, :3].copy()
    for _ in range(30):
        scene.step(expert(scene))
        now = scene.measured_state()[:, :3].copy()
        resting = np.where((np.abs(now - before).max(1) < 0.002) & ~done, resting + 1, 0)
        assert resting.max() <= 2
        before, done = now, done | scene.success()
    assert done.all()


FAR = """(define (problem study) (:domain robosuite) (:language turn on the stove)
  (:regions (place (:target desk) (:ranges ((RANGE)))))
  (:fixtures desk - study_table stove_1 - flat_stove) (:objects)
  (:init (On stove_1 desk_place)) (:goal (And (TurnOn stove_1))))
"""


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("0.30 0.0 0.31 0.01", None),
        ("0.40 0.0 0.40 0.0", r"fails at \(TurnOn stove_1\) in row 0: .* x = 0.33, y = -0.07 .*, 8 cm out of"),
        ("0.0 0.45 0.0 0.45", r"fails at \(TurnOn stove_1\) in row 0: .* x = -0.07, y = 0.38 .*, 3 cm out of"),
    ],
)
def test_a_lever_out_of_reach_is_said_once_with_how_far_and_one_within_is_turned(place, message, tmp_path):
    path = tmp_path / "far.bddl"
    path.write_text(FAR.replace("RANGE", place))
    scene = _scene(str(path), 2)
    expert, done = ScriptedExpert(scene.task), np.zeros(2, bool)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(250):
            scene.step(expert(scene))
            done |= scene.success()
    assert len(caught) == (message is not None) and done.all() == (message is None)
    assert message is None or re.search(message, str(caught[0].message))
