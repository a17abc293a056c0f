"""The expert as a policy acts in its own environment, and notices when it is played in another."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.transforms import StepCounter, TransformedEnv

from worldenv_trl.envs import ExpertPolicy, TabletopEnv
from worldenv_trl.keys import ACTION
from worldenv_trl.scenes import list_tasks

DRAWER, BOWL, STOVE = list_tasks("starter")


def make(task=DRAWER, n=2, **options):
    return TabletopEnv(task, n, **({"cameras": (), "seed": 0, "num_threads": 1, "init_state_mode": "cycle"} | options))


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (
            {"task": BOWL},
            "this expert's env asks to 'open the top drawer of the cabinet' in row 0, the .* 'put the bowl on",
        ),
        ({"task": [DRAWER, STOVE]}, "this expert's env has task_id=0 in row 1, the tensordict 1"),
        ({"n": 3}, "its own env of 2 rows, got 3 rows"),
        ({"init_state_id": 4}, "this expert's env has context_id=0 in row 0, the tensordict 4"),
        ({}, "this expert's env has num_steps=0 in row 0, the tensordict 1"),  # a twin, until it has made a step
    ],
)
def test_a_rollout_of_another_env_is_refused_with_what_differs(other, message):
    own = make()
    own.reset()
    with pytest.raises(ValueError, match=rf"{message}.*: make an ExpertPolicy of the env that it acts in"):
        make(**other).rollout(3, ExpertPolicy(own))


def test_a_tensordict_of_a_step_ago_is_refused():
    env = make()
    expert, start = ExpertPolicy(env), env.reset()
    env.step(expert(start.clone()))
    with pytest.raises(ValueError, match=r"has num_steps=1 in row 0, the tensordict 0: .* what that env showed last"):
        expert(start)


def test_an_env_without_simulations_of_this_process_is_refused():
    for env in (None, make):
        with pytest.raises(TypeError, match=f"needs a TabletopEnv of this process, got {type(env).__name__}"):
            ExpertPolicy(env)


def test_it_acts_through_transforms_partial_resets_and_states_put_back():
    env = make(n=4, max_steps=60, with_sim_state=True)
    outer = TransformedEnv(env, StepCounter(30))
    expert = ExpertPolicy(outer)
    rollout = outer.rollout(70, expert, break_when_any_done=False)
    assert rollout["next", "success"].any(1).all()
    assert (rollout["next", "done"].sum(1) >= 2).all()  # rows went on, each in its own time
    middle = rollout[:, 5].exclude("next", ACTION)
    again = outer.reset(middle.clone(), set_state=True)
    assert torch.equal(again["num_steps"], torch.full((4, 1), 5))
    assert expert(again)[ACTION].abs().max() > 0
    assert expert(TensorDict({"num_steps": again["num_steps"]}, [4]))[ACTION].shape == (4, 7)  # only what it needs
