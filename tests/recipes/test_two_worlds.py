"""The same actions in both worlds."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from config import GOAL_TASKS, PRESETS, SFT
from parts import make_policy
from physics import tabletop
from run import Run
from run_folder import RunFolder
from two_worlds import live, relive
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import Episodes, episodes_from_rollouts
from worldenv_trl.envs import ExpertPolicy, context_id
from worldenv_trl.metrics import first_success
from worldenv_trl.policies import laplace_actor


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    options = {"num_threads": 1, "tasks": GOAL_TASKS[1:], "max_steps": 32, "sft": SFT(dim=32, depth=1)}
    config = dataclasses.replace(PRESETS["smoke"][1], **options)
    return Run(config, RunFolder(tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def expert_episodes(run):
    """Two episodes of each task that reach the goal and go on."""
    parts = []
    for task in run.config.tasks:
        env = tabletop(run.config, "train", 2, [task], init_state_mode="cycle", terminate_on_success=False)
        collector = GroupCollector(env, ExpertPolicy(env), groups_per_batch=2, total_groups=2, max_decisions=32)
        parts.append(episodes_from_rollouts(next(iter(collector))[:, 0]))
        collector.shutdown()
    return Episodes.cat(parts)


def test_actions_played_again_come_to_the_same_frame_by_frame_in_any_order(run, expert_episodes):
    mixed = expert_episodes[torch.tensor([3, 0, 2, 1])]
    assert mixed["success"].any(1).all() and not mixed["success"][:, :10].any()
    assert (relive(run, mixed) == mixed["success"]).all()


def test_an_episode_is_played_as_long_as_it_lasts(run, expert_episodes):
    short = expert_episodes[torch.arange(4)]
    reached = first_success(short["success"])
    short["length"][0], short["length"][1] = int(reached[0]) - 1, int(reached[1])
    again = relive(run, short)
    assert not again[0].any() and first_success(again[1:]).tolist() == reached[1:].tolist()
    assert again[1, int(reached[1]) :].all()  # past its end the last value is repeated


def test_the_policy_lives_through_the_first_held_out_states(run):
    episodes = live(run, laplace_actor(make_policy(run.config)), range(2))
    assert len(episodes) == 4 and episodes.image_size == 64 and (episodes["length"] == 32).all()
    assert episodes[keys.CONTEXT_ID].flatten().tolist() == [context_id(t, "test", k) for t in (0, 1) for k in (0, 1)]
    second = live(run, laplace_actor(make_policy(run.config)), [1])
    assert second[keys.CONTEXT_ID].flatten().tolist() == [context_id(t, "test", 1) for t in (0, 1)]
    frames = [
        each.frames("agentview", torch.arange(2), torch.zeros(2, dtype=torch.long))
        for each in (second, episodes[torch.tensor([1, 3])])
    ]
    assert torch.equal(*frames)
