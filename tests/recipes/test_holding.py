"""What LOOP holds: tasks that greedy rollouts solved, and where the policy stood there."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from small_run import SMALL, small_untrained, token_policy, with_untrained_policy
from tensordict import TensorDict

import config
import holding
from checks import check_config, check_loop
from demonstrate import demonstrate
from explore import explore
from holding import Hold, greedy_exploration, solved_shares
from physics import exploring_actor, reached_goal
from post_train import post_train
from run import Run
from worldenv_trl import keys
from worldenv_trl.record import read_rollouts


def episodes(tasks, successes):
    """What the labels of episodes [R] say, each the success of its frames [R, T + 1]."""
    success = torch.zeros(len(tasks), 4, dtype=torch.bool)
    success[:, 2] = torch.tensor(successes)
    return {keys.TASK_ID: torch.tensor(tasks)[:, None], keys.SUCCESS: success}


def test_a_share_is_of_all_rollouts_of_a_task():
    shares = solved_shares(episodes([2, 0, 2, 0, 2, 5], [1, 1, 0, 1, 0, 0]))
    assert shares == {0: 1.0, 2: pytest.approx(1 / 3), 5: 0.0}


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    """An exploration whose second scale is greedy, and the demonstrations that are stored with it."""
    run = small_untrained(
        tmp_path_factory.mktemp("holding"),
        max_steps=40,
        explore=config.Explore(episodes_per_task=4, num_envs=2, scale_factors=(1.0, 0.0), replay_share=0.0),
    )
    demonstrate(run)
    explore(run)
    yield run
    run.close()


def test_greedy_exploration_is_the_part_without_noise(explored):
    greedy = greedy_exploration(explored, 1)
    every = read_rollouts(explored.folder.rollouts("explore"))
    policy = explored.policy("sft").eval()
    assert 0 < len(greedy) < len(every)
    own = every[-len(greedy) :]  # of two scales, the second
    assert torch.equal(greedy[keys.CONTEXT_ID], own[keys.CONTEXT_ID][:, 0])
    with torch.no_grad():
        mean = exploring_actor(explored.config, policy, 1.0).get_dist(own[:, 0]).loc[:, 0]
    torch.testing.assert_close(own[keys.ACTION][:, 0], mean.clamp(-1, 1), atol=1e-4, rtol=0)
    noisy = every[: -len(greedy)]
    with torch.no_grad():
        mean = exploring_actor(explored.config, policy, 1.0).get_dist(noisy[:, 0]).loc[:, 0]
    assert (noisy[keys.ACTION][:, 0] - mean).abs().mean() > 0.01
    succeeded = greedy[keys.SUCCESS].flatten(1).any(-1)
    assert torch.equal(succeeded, reached_goal(own))


def test_what_cannot_be_held_is_refused_before_any_work():
    held = dataclasses.replace(SMALL, post_train=dataclasses.replace(SMALL.post_train, hold=1.0))
    with pytest.raises(ValueError, match=r"explore.scale_factors must hold 0, got 1$"):
        check_config(held)  # whose exploration has no greedy part
    with pytest.raises(ValueError, match=r"post_train.hold is for policies with a mean, and Tokens acts by tokens"):
        check_loop(held, token_policy())


@pytest.fixture
def physics(tiny):
    """A run of LOOP in the physics, two groups of two an iteration, from an untrained policy."""
    learned = dataclasses.replace(tiny.post_train, iterations=2, env="tabletop", probe_every=0, lora_rank=0)
    return with_untrained_policy(dataclasses.replace(tiny, post_train=learned))


def learned(run, monkeypatch, weight, solved):
    """The weights after LOOP, held with ``weight`` if greedy rollouts solved this share, and what was logged."""
    monkeypatch.setattr(Run, "seed", lambda *_: 1)
    monkeypatch.setattr(
        holding, "greedy_exploration", lambda *_: episodes([0] * 20, [n < 20 * solved for n in range(20)])
    )
    settings = dataclasses.replace(run.config.post_train, hold=weight)
    run = dataclasses.replace(run, config=dataclasses.replace(run.config, post_train=settings))
    name = f"held_{weight}_{solved}"
    post_train(run, "sft", name, "", returns_of=lambda wave: wave[keys.CHUNK][..., :3].mean((-1, -2, -3)))
    return run.policy(name).state_dict(), run.folder.read_metrics(name)


def test_a_task_that_is_held_stays_and_one_that_is_not_is_learned_as_without(physics, monkeypatch):
    source = physics.policy("sft").state_dict()
    with pytest.warns(UserWarning, match=r"all tasks are held.* at least 0.85 of each"):
        held, logged = learned(physics, monkeypatch, 1.0, 0.85)
    assert all(torch.equal(value, source[name]) for name, value in held.items())
    assert [line["held_groups"] for line in logged if "return" in line] == [1.0, 1.0]
    failed, logged = learned(physics, monkeypatch, 1.0, 0.8)
    free, _ = learned(physics, monkeypatch, 0.0, 1.0)
    assert any(not torch.equal(value, source[name]) for name, value in free.items())
    assert all(torch.equal(value, free[name]) for name, value in failed.items())
    assert [line["held_groups"] for line in logged if "return" in line] == [0.0, 0.0]


def test_the_reference_is_what_the_source_does_at_held_decisions_alone(physics, monkeypatch):
    monkeypatch.setattr(holding, "greedy_exploration", lambda *_: episodes([4, 5], [0, 1]))
    hold = Hold(physics, "sft", "")
    wave = TensorDict({keys.TASK_ID: torch.tensor([4, 5]).view(2, 1, 1, 1).expand(2, 3, 4, 1)}, [2, 3, 4])
    assert hold.groups(wave).tolist() == [False, True]
    size = physics.config.image_size
    images = torch.randint(0, 255, (6, 3, size, size), dtype=torch.uint8)
    decisions = TensorDict({"observation": {"image": images, "state": torch.rand(6, 7)}}, [6])
    decisions.set(keys.INSTRUCTION, "open the top drawer")
    decisions[keys.CHUNK] = torch.zeros(6, 8, 7)
    held = torch.tensor([True, False, True, False, False, True])
    decisions[keys.HELD] = held[:, None]
    with torch.no_grad():
        expected = exploring_actor(physics.config, physics.policy("sft").eval(), 1.0).get_dist(decisions.clone())
    monkeypatch.setattr(holding, "rows_of", lambda _: 2)  # the last one alone
    hold.refer(decisions)
    torch.testing.assert_close(decisions[keys.REFERENCE_LOC][held], expected.loc[held])
    torch.testing.assert_close(decisions[keys.REFERENCE_SCALE][held], expected.scale[held])
    assert (decisions[keys.REFERENCE_LOC][~held] == 0).all() and (decisions[keys.REFERENCE_SCALE][~held] == 1).all()
