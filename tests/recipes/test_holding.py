"""What LOOP holds: tasks that greedy rollouts solved, and where the policy stood there."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch
from small_run import SMALL, token_policy, with_untrained_policy
from tensordict import TensorDict

import holding
from adapt import adapt
from checks import check_config, check_loop
from config import GOAL_TASKS
from holding import Hold, solved_shares
from physics import exploring_actor
from post_train import post_train
from run import Run
from stages import plan
from worldenv_trl import keys


def episodes(tasks, successes):
    """What the labels of episodes [R] say, each the success of its frames [R, T + 1]."""
    success = torch.zeros(len(tasks), 4, dtype=torch.bool)
    success[:, 2] = torch.tensor(successes)
    return {keys.TASK_ID: torch.tensor(tasks)[:, None], keys.SUCCESS: success}


def test_a_share_is_of_all_rollouts_of_a_task():
    shares = solved_shares(episodes([2, 0, 2, 0, 2, 5], [1, 1, 0, 1, 0, 0]))
    assert shares == {0: 1.0, 2: pytest.approx(1 / 3), 5: 0.0}


def test_what_cannot_be_held_is_refused_before_any_work_and_the_physics_asks_exploration_too():
    held = dataclasses.replace(SMALL, post_train=dataclasses.replace(SMALL.post_train, hold=1.0))
    with pytest.raises(ValueError, match=r"explore.scale_factors must hold 0, got 1$"):
        check_config(held)  # whose exploration has no greedy part
    physics = dataclasses.replace(SMALL, post_train=dataclasses.replace(SMALL.post_train, hold=1.0, env="tabletop"))
    assert [stage.name for stage in plan(physics)] == ["demonstrate", "sft", "explore", "post_train", "evaluate"]
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
    monkeypatch.setattr(holding, "explored_at", lambda *_: episodes([0] * 20, [n < 20 * solved for n in range(20)]))
    settings = dataclasses.replace(run.config.post_train, hold=weight)
    run = dataclasses.replace(run, config=dataclasses.replace(run.config, post_train=settings))
    name = f"held_{weight}_{solved}"
    post_train(run, "sft", name, "", returns_of=lambda wave: wave[keys.CHUNK][..., :3].mean((-1, -2, -3)))
    return run.policy(name).state_dict(), run.folder.read_metrics(name)


def test_where_all_tasks_are_held_nothing_is_adapted_and_that_is_said(physics, monkeypatch, capsys):
    monkeypatch.setattr(holding, "explored_at", lambda *_: episodes([0, 0], [1, 1]))
    settings = dataclasses.replace(physics.config.post_train, hold=1.0)
    adapt(dataclasses.replace(physics, config=dataclasses.replace(physics.config, post_train=settings)))
    assert "adapt: left out, all tasks are held" in capsys.readouterr().out
    source, kept = physics.policy("sft").state_dict(), physics.policy("adapted").state_dict()
    assert all(torch.equal(value, source[name]) for name, value in kept.items())


def test_where_all_tasks_are_held_loop_is_left_out(physics, monkeypatch):
    again = rf"LOOP are left out: .* at least 0.85 of each; a new run with --begin-from {physics.folder.path} and"
    with pytest.warns(UserWarning, match=again):
        held, logged = learned(physics, monkeypatch, 1.0, 0.85)
    source = physics.policy("sft").state_dict()
    assert all(torch.equal(value, source[name]) for name, value in held.items())
    assert not any("return" in line for line in logged)


class Unaware(Hold):
    """Goes on as where another task is not held."""

    everything = property(lambda _: False, lambda *_: None)


def test_a_task_that_is_held_stays_and_one_that_is_not_is_learned_as_without(physics, monkeypatch):
    source = physics.policy("sft").state_dict()
    with monkeypatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setattr("post_train.Hold", Unaware)
        held, logged = learned(physics, patch, 1.0, 0.85)
    assert all(torch.equal(value, source[name]) for name, value in held.items())
    assert [line["held_groups"] for line in logged if "return" in line] == [1.0, 1.0]
    with pytest.warns(
        UserWarning, match=r"no task is held: .* at most 0.80 of one, and --post-train.hold-from is 0.85"
    ):
        failed, logged = learned(physics, monkeypatch, 1.0, 0.8)
    free, _ = learned(physics, monkeypatch, 0.0, 1.0)
    assert any(not torch.equal(value, source[name]) for name, value in free.items())
    assert all(torch.equal(value, free[name]) for name, value in failed.items())
    assert [line["held_groups"] for line in logged if "return" in line] == [0.0, 0.0]


def test_the_reference_is_what_the_source_does_at_held_decisions_alone(physics, monkeypatch, capsys):
    monkeypatch.setattr(holding, "explored_at", lambda *_: episodes([0, 1], [0, 1]))
    hold = Hold(dataclasses.replace(physics, config=dataclasses.replace(physics.config, tasks=GOAL_TASKS)), "sft", "")
    assert capsys.readouterr().out == f"held: {GOAL_TASKS[1]} (1.00)\n"
    wave = TensorDict({keys.TASK_ID: torch.tensor([0, 1]).view(2, 1, 1, 1).expand(2, 3, 4, 1)}, [2, 3, 4])
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
