"""Tasks from files: initial states at rest, goals judged as the file asks, and LIBERO's own files."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
from torchrl.envs.utils import check_env_specs

from worldenv_trl.envs import TabletopEnv
from worldenv_trl.robot import WRIST, look_at
from worldenv_trl.scenes import SceneBatch, ScriptedExpert, initial, load_task
from worldenv_trl.scenes.simulation import cameras_of

TEXT = """
(define (problem tabletop) (:domain robosuite) (:language put the bowl on the plate and the soup in the basket)
  (:regions
    (left_region (:target table_1) (:ranges ((-0.12 -0.20 -0.04 -0.12))))
    (right_region (:target table_1) (:ranges ((-0.15 0.0 0.0 0.08))))
    (far_region (:target table_1) (:ranges ((0.02 0.20 0.04 0.22))))
    (near_region (:target table_1) (:ranges ((0.10 -0.10 0.14 -0.06))))
    (contain_region (:target basket_1)))
  (:fixtures table_1 - table)
  (:objects bowl_1 - akita_black_bowl plate_1 - plate basket_1 - basket soup_1 - alphabet_soup)
  (:init (On bowl_1 table_1_left_region) (On plate_1 table_1_right_region) (On basket_1 table_1_far_region)
         (On soup_1 table_1_near_region))
  (:goal (And (On bowl_1 plate_1) (In soup_1 basket_1_contain_region))))
"""
LIBERO = os.environ.get("WORLDENV_TRL_LIBERO_BDDL")


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "two_things.bddl"
    path.write_text(TEXT)
    return path


def put(scene: SceneBatch, row: int, thing: str, position) -> None:
    start = scene.model.jnt_qposadr[scene.model.body(f"{thing}/").jntadr[0]]
    scene.qpos[row, start : start + 3] = position
    scene.qpos[row, start + 3 : start + 7] = (1, 0, 0, 0)


def test_initial_states_are_at_rest_reproducible_and_distinct(path):
    task = load_task(path)
    train, test = task.init_states("train", 6), task.init_states("test", 6)
    assert np.array_equal(train[:3], task.init_states("train", 3))
    assert len(np.unique(np.concatenate([train, test]), axis=0)) == 12
    scene = SceneBatch(task, 6, cameras=(), num_threads=1)
    scene.reset(np.arange(6), train)
    before = scene.xpos.copy()
    for _ in range(10):
        scene.step(np.zeros((6, 7)))
    things = [scene.model.body(f"{name}/").id for name in ("bowl_1", "plate_1", "basket_1", "soup_1")]
    assert np.abs(scene.xpos[:, things] - before[:, things]).max() < 2e-3
    assert not scene.success().any()


def test_the_goal_holds_only_when_every_predicate_does(path):
    task = load_task(path)
    scene = SceneBatch(task, 5, cameras=(), num_threads=1)
    scene.reset(np.arange(5), task.init_states("train", 5))
    plate, basket = (scene.xpos[:, scene.model.body(f"{name}/").id].copy() for name in ("plate_1", "basket_1"))
    on_plate, in_basket = (0.01, 0.0, 0.0119), (0.0, 0.02, 0.009)
    for row in (0, 1, 3, 4):
        put(scene, row, "bowl_1", plate[row] + on_plate)
    for row in (0, 2, 3, 4):
        put(scene, row, "soup_1", basket[row] + in_basket)
    put(scene, 3, "bowl_1", plate[3] + (0.035, 0.0, 0.0119))  # touches, but off the centre
    put(scene, 4, "bowl_1", plate[4] + (0.01, 0.0, 0.05))  # above the plate, in the air
    scene.batch.forward(np.arange(5, dtype=np.int32), stage=mujoco.mjtStage.mjSTAGE_POS.value)
    relations = task.relations
    assert relations.evaluate(scene, "On", "bowl_1", "plate_1").tolist() == [True, True, False, False, False]
    inside = relations.evaluate(scene, "In", "soup_1", "basket_1_contain_region")
    assert inside.tolist() == [True, False, True, True, True]
    assert scene.success().tolist() == [True, False, False, False, False]


def test_a_file_is_an_environment_like_any_other(path):
    env = TabletopEnv(str(path), 2, image_size=32, max_steps=4, seed=0)
    check_env_specs(env, seed=0)
    rollout = env.rollout(4)
    assert rollout["observation", "image"].shape == (2, 4, 3, 32, 32)
    assert rollout[0, 0]["language_instruction"] == "put the bowl on the plate and the soup in the basket"
    assert not rollout["task_id"].any()  # the first and only of this run
    env.close()


def test_the_expert_puts_one_thing_on_and_the_other_into_its_place(path):
    task = load_task(path)
    scene, expert = SceneBatch(task, 10, cameras=(), num_threads=1), ScriptedExpert(task)
    scene.reset(np.arange(10), task.init_states("train", 10))
    solved = np.zeros(10, bool)
    for _ in range(140):
        scene.step(expert(scene))
        solved |= scene.success()
    assert solved.sum() >= 9


def test_a_goal_without_a_script_is_refused(path):
    path.write_text(TEXT.replace("- alphabet_soup", "- cookies").replace("0.10 -0.10 0.14 -0.06", "0.1 -0.2 0.1 -0.2"))
    with pytest.raises(ValueError, match=r"no script for .*soup_1 cannot be gripped"):
        ScriptedExpert(load_task(path))


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("(On bowl_1 plate_1)", "(Open plate_1)", 13, "plate_1 has no joint for Open"),
        ("(On bowl_1 plate_1)", "(Open table_1)", 13, "table_1 has no joint for Open"),
        ("(On bowl_1 plate_1)", "(On bowl_1 table_1)", 13, "table_1 is the workspace: name one of its regions"),
        ("(On bowl_1 plate_1)", "(On bowl_1 bowl_1)", 13, "cannot be put on or into itself"),
        ("(On bowl_1 plate_1)", "(On table_1 plate_1)", 13, "table_1 is not a thing: it cannot be put somewhere"),
        ("(On bowl_1 plate_1)", "(In bowl_1 plate_1)", 13, "plate_1 has no contain_region: did you mean On"),
        ("(On bowl_1 plate_1)", "(In bowl_1 table_1_far_region)", 13, "is flat: nothing is in it, say On"),
        ("(contain_region (:target basket_1))", "(contain_region (:target plate_1))", 13, "'plate_1_contain_region'"),
        ("(In soup_1 basket_1_contain_region)", "(In basket_1_contain_region soup_1)", 13, "is not a thing"),
        ("0.10 -0.10 0.14 -0.06", "0.02 0.20 0.04 0.22", 7, "soup_1 cannot be placed in it clear of basket_1"),
        (
            "0.10 -0.10 0.14 -0.06",
            "10 -10 14 -6",
            7,
            r"\(10 -10 14 -6\) lies off the table: x = 10 is not in \[-0.56, 0",
        ),
    ],
)
def test_what_cannot_be_laid_out_or_judged_is_refused_with_file_and_line(path, old, new, line, message):
    assert old in TEXT
    path.write_text(TEXT.replace(old, new))
    with pytest.raises((ValueError, RuntimeError), match=rf"two_things\.bddl:{line}: .*{message}"):
        load_task(path).init_states("train", 50)


def test_what_never_comes_to_rest_is_refused_after_few_draws(path, monkeypatch):
    monkeypatch.setattr(initial, "_MOVED", 1e-9)  # as if everything fell
    message = r"two_things\.bddl:1[12]: '\(On (\w+) \w+\)': \1 does not come to rest there in any of 100 draws"
    with pytest.raises(RuntimeError, match=message):
        load_task(path).init_states("train", 50)


def test_a_goal_that_holds_from_the_start_is_refused_after_few_draws(path):
    asked = "(:goal (And (On bowl_1 table_1_left_region)))"
    path.write_text(TEXT[: TEXT.index("(:goal")] + asked + ")")
    message = r"two_things\.bddl:13: '\(On bowl_1 table_1_left_region\)': the goal holds in all of 100 draws"
    with pytest.raises(RuntimeError, match=message):
        load_task(path).init_states("train", 50)


def test_comments_and_white_space_leave_a_task_and_its_states_what_they_are(path):
    task = load_task(path)
    initial.save_poses(task, task.states, 2)
    drawn = task.init_states("train", 4)
    path.write_text("; mine\n" + TEXT.replace(" (On soup_1", "\n\t( On  soup_1 ; here\n  ").replace("\n", "\r\n"))
    commented = load_task(path)
    assert commented.digest == task.digest and len(task.digest) == 64
    assert np.array_equal(commented.init_states("train", 4), drawn)
    path.write_text(TEXT.replace("-0.12 -0.20", "-0.12 -0.21"))
    assert load_task(path).digest != task.digest


def test_a_scene_has_the_cameras_of_its_task(path):
    task = load_task(path)
    side = look_at("sideview", (0.0, 0.9, 0.5), (0.0, 0.0, 0.05), 45.0)
    palm = dataclasses.replace(WRIST, name="palm", fovy=60.0)
    more = dataclasses.replace(task, cameras=(*task.cameras, side, palm))
    assert list(cameras_of(more)) == ["agentview", "sideview", "wrist", "palm"]
    assert more.build() is not task.build() and np.array_equal(more.init_states("test", 2), task.init_states("test", 2))
    scene = SceneBatch(more, 2, cameras=("agentview", "palm", "wrist", "sideview"), image_size=32, num_threads=1)
    scene.reset(np.arange(2), more.init_states("train", 2))
    images = scene.render()
    assert list(images) == ["agentview", "palm", "wrist", "sideview"]
    assert all(image.std() > 10 for image in images.values())
    plain = SceneBatch(task, 2, cameras=("wrist",), image_size=32, num_threads=1)
    plain.reset(np.arange(2), task.init_states("train", 2))
    assert np.array_equal(images["wrist"], plain.render()["wrist"])
    assert not np.array_equal(images["wrist"], images["palm"])


def test_states_stored_beside_a_file_are_its_standard_ones(path):
    task = load_task(path)
    drawn = task.init_states("train", 3)
    unwanted = drawn[1:2]
    initial.save_poses(task, task.states, 2, lambda states: (states != unwanted).any(-1))
    assert task.states == path.with_suffix(".npz")
    copy = path.with_name("copy.bddl")
    copy.write_text(TEXT)
    task.states.rename(copy.with_suffix(".npz"))
    stored = load_task(copy).init_states("train", 3)
    assert (stored == drawn).all(-1).tolist() == [True, False, True]  # the second was drawn again
    assert np.array_equal(load_task(path).init_states("train", 3), drawn)
    copy.write_text(TEXT.replace("put the bowl", "lay the bowl"))
    remedy = r"make them again with python recipes/init_states\.py --tasks .*copy\.bddl"
    with pytest.raises(RuntimeError, match=rf"copy\.npz holds initial states of another version of .*{remedy}"):
        load_task(copy).init_states("train", 1)


@pytest.mark.parametrize("content", ["arrays", "text", "nothing"])
def test_another_file_of_that_name_is_refused_and_kept(path, content):
    other = path.with_suffix(".npz")
    if content == "arrays":
        np.savez(other, train=np.zeros(3))
    else:
        other.write_text("mine" * (content == "text"))
    kept, task = other.read_bytes(), load_task(path)
    with pytest.raises(RuntimeError, match=r"two_things\.npz holds no initial states .*: move it away"):
        task.init_states("train", 1)
    with pytest.raises(RuntimeError, match=r"two_things\.npz holds something other than initial states .*: move it"):
        initial.save_poses(task, other, 1)
    assert other.read_bytes() == kept
    assert {item.name for item in path.parent.iterdir()} == {path.name, other.name}


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.bddl"):
        load_task(tmp_path / "nothing.bddl")


@pytest.mark.skipif(not LIBERO, reason="set WORLDENV_TRL_LIBERO_BDDL to LIBERO's folder bddl_files")
@pytest.mark.parametrize("suite", ["libero_spatial", "libero_object", "libero_goal", "libero_10"])
def test_the_files_of_libero_load_reset_render_and_judge_their_goals(suite):
    files = sorted(Path(LIBERO, suite).glob("*.bddl"))
    assert len(files) == 10
    for file in files:
        env = TabletopEnv(str(file), 2, image_size=32, init_state_count=2, max_steps=2, seed=0, num_threads=1)
        rollout = env.rollout(2)
        assert rollout["observation", "image"].float().std() > 10
        assert not rollout["next", "success"].any()
        env.close()
