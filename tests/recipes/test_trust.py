"""What imagination is trusted with: its verdicts against what exploration has found out."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch
from small_run import SMALL, with_untrained_policy
from tensordict import TensorDict

import holding
import trust
from checks import check_config
from config import GOAL_TASKS
from holding import Hold
from worldenv_trl import keys
from worldenv_trl.envs import context_id


def explored(outcomes):
    """Greedy episodes of each task's first initial states, in turn, with these outcomes by task."""
    numbers = [(task, state) for task, row in enumerate(outcomes) for state in range(len(row))]
    success = torch.zeros(len(numbers), 4, dtype=torch.bool)
    success[:, 2] = torch.tensor([outcomes[task][state] for task, state in numbers], dtype=torch.bool)
    return {
        keys.TASK_ID: torch.tensor([task for task, _ in numbers])[:, None],
        keys.CONTEXT_ID: torch.tensor([context_id(task, "train", state) for task, state in numbers])[:, None],
        keys.SUCCESS: success,
    }


@pytest.fixture
def run(tiny):
    learned = dataclasses.replace(tiny.post_train, hold=1.0, hold_from=0.9, trust=0.5)
    return dataclasses.replace(
        with_untrained_policy(tiny), config=dataclasses.replace(tiny, tasks=GOAL_TASKS, post_train=learned)
    )


def imagining(monkeypatch, outcomes, verdicts):
    """An imagination of contexts in another order than exploration's, one of which it did not begin from, and what is
    said of them; returns it and the numbers of contexts asked for, wave by wave."""
    told = explored(outcomes)
    order = torch.randperm(len(told[keys.CONTEXT_ID]), generator=torch.Generator().manual_seed(0))
    number, task = (told[key][order] for key in (keys.CONTEXT_ID, keys.TASK_ID))
    unexplored = torch.tensor([[context_id(0, "train", 40)]])
    contexts = TensorDict(
        {
            keys.CONTEXT_ID: torch.cat([unexplored, number]),
            keys.TASK_ID: torch.cat([torch.zeros_like(unexplored), task]),
        },
        batch_size=[len(number) + 1],
    )
    says = {
        context_id(task, "train", state): each for task, row in enumerate(verdicts) for state, each in enumerate(row)
    }
    waves = []

    def said(run, actor, imagination, asked):
        waves.append(asked[keys.CONTEXT_ID].flatten().tolist())
        return torch.tensor([bool(says[each]) for each in waves[-1]])

    monkeypatch.setattr(trust, "imagined_outcomes", said)
    for module in (trust, holding):
        monkeypatch.setattr(module, "explored_at", lambda *_: told)
    return SimpleNamespace(contexts=contexts), waves


def test_it_is_agreement_beyond_chance_state_by_state(run, monkeypatch):
    outcomes = [[1, 1, 0, 0], [1, 0, 1, 0], [1, 1, 1, 1]]
    imagination, waves = imagining(monkeypatch, outcomes, [[1, 1, 0, 0], [1, 1, 0, 0], [1, 1, 1, 1]])
    found = trust.agreement(run, imagination, "", [0, 1, 2])
    assert found[0] == 1.0 and found[1] == 0.0 and math.isnan(found[2])
    assert max(map(len, waves)) <= run.config.post_train.groups * run.config.post_train.group_size
    assert trust.agreement(run, imagination, "", [1]) == {1: 0.0}


def test_a_task_that_imagination_does_not_know_is_held_like_a_solved_one(run, monkeypatch, capsys):
    imagination, waves = imagining(
        monkeypatch, [[1, 1, 0, 0], [1, 0, 1, 0], [1, 1, 1, 1]], [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0]]
    )
    hold = Hold(run, "sft", "", imagination)
    assert not hold.everything
    wave = TensorDict({keys.TASK_ID: torch.arange(3).view(3, 1, 1, 1).expand(3, 2, 4, 1)}, [3, 2, 4])
    assert hold.groups(wave).tolist() == [False, True, True]
    assert capsys.readouterr().out == (
        "imagination's verdicts and exploration's outcomes agree too little to learn from: "
        f"{GOAL_TASKS[1]} (0.00)\nheld: {GOAL_TASKS[2]} (1.00)\n"
    )
    asked = {number for each in waves for number in each}
    assert not asked & {context_id(2, "train", state) for state in range(4)}  # what is solved is not asked


def test_where_all_is_solved_nobody_asks(run, monkeypatch):
    imagination, waves = imagining(monkeypatch, [[1, 1, 1, 1]] * 3, [[0, 0, 0, 0]] * 3)
    with pytest.warns(UserWarning, match="all tasks are held, so adapting and LOOP are left out"):
        assert Hold(run, "sft", "", imagination).everything
    assert not waves


def test_where_nothing_is_known_loop_is_left_out_and_that_is_said(run, monkeypatch):
    imagination, _ = imagining(monkeypatch, [[1, 0, 1, 0]] * 3, [[1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 0]])
    with pytest.warns(UserWarning, match="0 solved and 3 unknown to imagination, so LOOP is left out"):
        assert Hold(run, "sft", "", imagination).everything


def test_nobody_asks_in_the_physics_or_without_trust(run, monkeypatch):
    imagination, waves = imagining(monkeypatch, [[1, 0, 1, 0]] * 3, [[0, 0, 0, 0]] * 3)
    without = dataclasses.replace(run.config, post_train=dataclasses.replace(run.config.post_train, trust=0.0))
    with pytest.warns(UserWarning, match="no task is held"):
        Hold(run, "sft", "")
        Hold(dataclasses.replace(run, config=without), "sft", "", imagination)
    assert not waves


def test_trust_without_holding_is_refused():
    with pytest.raises(ValueError, match=r"post_train.trust=0.5 holds tasks: post_train.hold must be above 0"):
        check_config(dataclasses.replace(SMALL, post_train=dataclasses.replace(SMALL.post_train, trust=0.5)))
