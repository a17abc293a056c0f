"""The same actions in both worlds."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from config import GOAL_TASKS, PRESETS
from parts import tabletop, task_instructions
from two_worlds import first_success, judged, live, relive
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import concatenate_episodes, episodes_from_rollouts
from worldenv_trl.envs import ExpertPolicy, context_id
from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor


@pytest.fixture(scope="module")
def config():
    return dataclasses.replace(PRESETS["smoke"][1], num_threads=1, tasks=GOAL_TASKS[1:], max_steps=32)


@pytest.fixture(scope="module")
def expert_episodes(config):
    """Two episodes of each task that reach the goal and go on."""
    parts = []
    for task in config.tasks:
        env = tabletop(config, "train", 2, [task], init_state_mode="cycle", terminate_on_success=False)
        collector = GroupCollector(env, ExpertPolicy(env), groups_per_batch=2, total_groups=2, max_decisions=32)
        parts.append(episodes_from_rollouts(next(iter(collector))[:, 0]))
        collector.shutdown()
    return concatenate_episodes(parts)


def test_actions_played_again_come_to_the_same_frame_by_frame_in_any_order(config, expert_episodes):
    mixed = expert_episodes[torch.tensor([3, 0, 2, 1])].clone()
    assert mixed["success"].any(1).all() and not mixed["success"][:, :10].any()
    assert (relive(config, mixed) == mixed["success"]).all()


def test_an_episode_is_played_as_long_as_it_lasts(config, expert_episodes):
    short = expert_episodes.clone()
    reached = first_success(short["success"])
    short["length"][0], short["length"][1] = int(reached[0]) - 1, int(reached[1])
    again = relive(config, short)
    assert not again[0].any() and first_success(again[1:]).tolist() == reached[1:].tolist()
    assert again[1, int(reached[1]) :].all()  # past its end the last value is repeated


def test_the_policy_lives_through_the_first_held_out_states(config):
    policy = OFTPolicy(OFTConfig.for_tasks(task_instructions(config), dim=32, depth=1))
    episodes = live(config, laplace_actor(policy), per_task=2)
    assert episodes["frames"].shape == (4, 33, 3, 64, 64) and (episodes["length"] == 32).all()
    assert episodes[keys.CONTEXT_ID].flatten().tolist() == [context_id(t, "test", k) for t in (0, 2) for k in (0, 1)]


def test_a_stop_ends_the_episode_and_may_come_a_little_early():
    stop, reached = torch.tensor([10, 10, 10, 10, -1, -1]), torch.tensor([8, 12, 13, -1, 30, -1])
    imagined, real = judged(stop, reached)
    assert imagined.tolist() == [True, True, True, True, False, False]
    assert real.tolist() == [True, True, False, False, True, False]
    assert judged(stop, reached, late=0)[1].tolist() == [True, False, False, False, True, False]


def test_the_first_success_is_found():
    success = torch.tensor([[False, True, False], [False, False, False], [True, True, True]])
    assert first_success(success).tolist() == [1, -1, 0]
