"""What TabletopEnv refuses when it is built: one error that names the argument and its value."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from worldenv_trl.envs import TabletopEnv
from worldenv_trl.keys import CONTEXT_ID
from worldenv_trl.robot import look_at
from worldenv_trl.scenes import list_tasks, load_task

TASKS = list_tasks("starter")
DRAWER = TASKS[0]


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("starter/open_the_top_drawr", {}, "did you mean 'starter/open_the_top_drawer'"),
        ([], {}, "task is empty"),
        ([DRAWER, DRAWER], {}, "named twice"),
        (TASKS, {}, "3 tasks need at least 3 rows, got num_envs=2"),
        (DRAWER, {"num_envs": 0}, "num_envs must be a whole number of at least 1, got 0"),
        (DRAWER, {"num_envs": 2.0}, "num_envs must be a whole number of at least 1, got 2.0"),
        (DRAWER, {"group_repeats": 0}, "group_repeats must be a whole number of at least 1, got 0"),
        (DRAWER, {"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        (DRAWER, {"seed": 1.5}, "seed must be a whole number of at least 0, got 1.5"),
        (DRAWER, {"seed": "1"}, "seed must be a whole number of at least 0, got '1'"),
        (DRAWER, {"init_state_id": -1}, "init_state_id must be a whole number of at least 0, got -1"),
        (DRAWER, {"init_state_id": 0.5}, "init_state_id must be a whole number of at least 0, got 0.5"),
        (DRAWER, {"init_state_count": 0}, "init_state_count must be a whole number of at least 1, got 0"),
        (DRAWER, {"init_state_count": 10**9}, "init_state_count must be at most 50000, got 1000000000: context ids"),
        (DRAWER, {"init_state_id": 50_000}, "init_state_id must be at most 49999, got 50000: context ids"),
        (DRAWER, {"max_steps": 10**30}, "max_steps must be at most 2147483647, got 10"),
        (DRAWER, {"num_threads": 0}, "num_threads must be a whole number of at least 1, got 0"),
        (DRAWER, {"group_repeats": 3}, "multiple of group_repeats, got 2 and 3"),
        (DRAWER, {"image_size": 8}, "from 16 to 4096 px, got 8"),
        (DRAWER, {"cameras": ("front",)}, f"unknown camera 'front': {DRAWER} has agentview, wrist"),
        (DRAWER, {"cameras": ("wrist", "wrist")}, "a camera is named twice: wrist, wrist"),
        (DRAWER, {"task_ids": (0, 1)}, "got 1 tasks and 2 task_ids"),
        (DRAWER, {"task_ids": (-1,)}, "a task id must be a whole number of at least 0, got -1"),
        (DRAWER, {"task_ids": (1.0,)}, "a task id must be a whole number of at least 0, got 1.0"),
        (TASKS[:2], {"task_ids": (4, 4)}, "two tasks have one id: task_ids are 4, 4"),
        (DRAWER, {"init_split": "val"}, "unknown split 'val'"),
        (DRAWER, {"init_state_mode": "next"}, "got 'next'"),
        (DRAWER, {"init_state_id": 50, "init_state_mode": "cycle"}, r"\[0, 50\), got 50"),
        (DRAWER, {"max_steps": 0}, "max_steps must be a whole number of at least 1, got 0"),
        (DRAWER, {"proprio": "true"}, "got 'true'"),
        (DRAWER, {"context_ids": [1]}, "pass both or neither"),
    ],
)
def test_settings_that_cannot_be_are_refused(task, options, message):
    with pytest.raises(ValueError, match=message):
        TabletopEnv(task, **({"num_envs": 2, "image_size": 16, "cameras": ()} | options))


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        (None, {}, "task must be a task, its name or file, or a list of those, got None: try 'starter/"),
        ({DRAWER: 2}, {}, "task must be .* got {'starter/open_the_top_drawer': 2}"),
        ([DRAWER, None], {}, "task must list tasks, their names or files, got None among them"),
        (DRAWER, {"terminate_on_success": "no"}, "terminate_on_success must be True or False, got 'no'"),
        (DRAWER, {"with_sim_state": 1}, "with_sim_state must be True or False, got 1"),
        (DRAWER, {"task_ids": 3}, r"task_ids must be a sequence of whole numbers, got 3"),
        (DRAWER, {"cameras": None}, r"cameras must be a sequence of names, got None: write \(\)"),
    ],
)
def test_arguments_of_another_kind_are_named(task, options, message):
    with pytest.raises(TypeError, match=message):
        TabletopEnv(task, **({"num_envs": 2, "cameras": ()} | options))


def with_camera(name, label):
    """The task ``name`` with a camera ``label`` in its scene."""
    task = load_task(name)
    return dataclasses.replace(task, cameras=(*task.cameras, look_at(label, (0.0, 0.8, 0.4), (0.0, 0.0, 0.1), 45.0)))


def test_a_camera_must_be_in_the_scenes_of_all_tasks():
    with pytest.raises(ValueError, match=f"unknown camera 'side': {TASKS[1]} has agentview, wrist"):
        TabletopEnv([with_camera(DRAWER, "side"), TASKS[1]], 2, cameras=("agentview", "side"))
    env = TabletopEnv([with_camera(DRAWER, "side"), with_camera(TASKS[1], "side")], 2, image_size=16, cameras=("side",))
    assert list(env.reset()["observation"].keys()) == ["side", "state"]
    env.close()


@pytest.mark.parametrize(("label", "cameras"), [("state", ("state",)), ("image", ("image", "agentview"))])
def test_cameras_whose_images_would_take_another_entry_s_place_are_refused(label, cameras):
    with pytest.raises(ValueError, match="would be written over one another: rename a camera"):
        TabletopEnv(with_camera(DRAWER, label), cameras=cameras)


def test_numbers_of_numpy_are_numbers():
    env = TabletopEnv(DRAWER, np.int64(1), image_size=np.int32(16), with_sim_state=np.True_, max_steps=np.int16(3))
    assert env.reset()["observation", "image"].shape == (1, 3, 16, 16)
    env.close()


@pytest.mark.parametrize("seed", [-1, 1.5, True])
def test_a_seed_that_cannot_be_is_refused_and_the_old_one_stays(seed):
    env, other = (TabletopEnv(DRAWER, 4, cameras=(), seed=0) for _ in range(2))
    with pytest.raises(ValueError, match=f"seed must be a whole number of at least 0, got {seed}"):
        env.set_seed(seed)
    assert torch.equal(env.reset()[CONTEXT_ID], other.reset()[CONTEXT_ID])
