"""A policy that is taught where its hand has to go, by what exploration found."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from small_run import SMALL, small_untrained

import config
import correct as correcting
from checks import check_config
from correct import Corrections, correct, taking_tasks
from demonstrate import demonstrate
from episodes import explored_at
from explore import explore
from sft import lowest_heights
from worldenv_trl import keys
from worldenv_trl.data import corrected_samples, until_reached
from worldenv_trl.language import instructions_of

TASKS = config.GOAL_TASKS[1:]


@pytest.fixture(scope="module")
def explored_run(tmp_path_factory):
    run = small_untrained(
        tmp_path_factory.mktemp("correct"),
        max_steps=24,
        tasks=TASKS,
        sft=config.SFT(batch_size=16, decision_share=0.5),
        explore=config.Explore(episodes_per_task=8, num_envs=4, scale_factors=(0.0, 1.0, 2.0)),
        adapt=config.Adapt(steps=1, correct_steps=60),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("demonstrate.check_solved", lambda *_: None)  # so few steps are not enough for the expert
        demonstrate(run)
    explore(run)
    yield run
    run.close()


def told(run, number, factors):
    """What was explored, as if hands closed at step 8 and every other rollout of the first task reached its goal."""
    episodes = explored_at(run, number, factors)
    episodes["actions"][..., 6] = torch.where(torch.arange(24) < 8, -1.0, 1.0)
    reached = (torch.arange(len(episodes)) % 2 == 0) & (episodes[keys.TASK_ID].squeeze(-1) == 0)
    episodes["success"] = reached.unsqueeze(-1) & (torch.arange(25) >= 20)
    return episodes


def failing(episodes):
    episodes["success"] &= False
    return until_reached(episodes)


@pytest.fixture
def run(explored_run, monkeypatch):
    monkeypatch.setattr(correcting, "explored_at", told)
    monkeypatch.setattr(correcting, "solved_tasks", lambda *_: [])
    return explored_run


def test_each_task_has_as_many_demonstrations_as_corrections_in_a_batch_and_half_as_much_that_is_kept(run):
    lessons = Corrections(run, 1)
    assert lessons.tasks == {0} and lessons.told >= 1
    torch.manual_seed(0)
    rows = lessons.draw(20_000)
    episode = lessons._samples["episode"][rows]
    assert lessons._samples[keys.WAYPOINT].isfinite().all()  # no place is unknown
    shown = episode < len(TASKS)
    assert shown.float().mean().item() == pytest.approx(0.8 / 1.4, abs=0.02)  # the second task has nothing else
    counts = episode[shown].bincount().float() / shown.sum()
    assert counts.tolist() == pytest.approx([1 / len(TASKS)] * len(TASKS), abs=0.02)
    decides = lessons._samples[keys.NUM_STEPS][rows].squeeze(-1) % run.config.chunk_length == 0
    assert decides[shown].float().mean().item() == pytest.approx(0.5 + 0.5 / 8, abs=0.03)


def test_noise_that_closes_a_gripper_now_and_then_corrects_nothing(run, monkeypatch):
    def explored(run_, number, factors):
        episodes = told(run_, number, factors)
        other = (episodes[keys.TASK_ID].squeeze(-1) == 1).nonzero().squeeze(-1)
        episodes["success"][other] = torch.arange(25) >= 20
        episodes["actions"][other[1:], :, 6] = -1.0
        return episodes

    monkeypatch.setattr(correcting, "explored_at", explored)
    episodes = until_reached(explored(run, 1, [0.0, 1.0]))
    all_of_them = corrected_samples(episodes, torch.zeros(len(episodes)))["episode"]
    assert episodes[keys.TASK_ID][all_of_them].unique().tolist() == [0, 1]
    assert taking_tasks(episodes) == [0]
    assert Corrections(run, 1).tasks == {0}


def test_a_lesson_shows_what_was_seen_there(run):
    lessons = Corrections(run, 1)
    rows = torch.randint(len(lessons), (30,))
    batch = lessons[rows]
    episode, step = lessons._samples["episode"][rows], lessons._samples[keys.NUM_STEPS][rows].squeeze(-1)
    assert torch.equal(batch[keys.IMAGE], lessons._episodes.frames("agentview", episode, step))
    assert torch.equal(batch[keys.STATE], lessons._episodes["states"][episode, step])
    assert instructions_of(batch) == [lessons._episodes.instructions[row] for row in episode.tolist()]
    shown = lessons._episodes[torch.arange(len(TASKS))]
    texts = [text for row, text in enumerate(shown.instructions) for _ in range(int(shown["length"][row]))]
    states = torch.cat([shown["states"][row, : int(shown["length"][row])] for row in range(len(TASKS))])
    assert lessons.lowest == lowest_heights(texts, states)


def distance(run, policy):
    """How far its means are from what the corrected decisions ask for."""
    lessons = Corrections(run, 1)
    first = lessons._samples["episode"] >= len(TASKS)
    rows = (first & (lessons._samples[keys.NUM_STEPS].squeeze(-1) == 0)).nonzero().squeeze(-1)
    batch = lessons[rows]
    with torch.no_grad():
        loc = policy(batch.copy())[keys.LOC]
    return ((loc - batch[keys.CHUNK]).abs()[~batch[keys.ACTION_IS_PAD]]).mean().item()


def parameters_of(policy):
    return [each for group in policy.post_training_parameters(0).values() for each in group]


def test_the_policy_goes_where_it_was_told(run, monkeypatch):
    monkeypatch.setattr(correcting, "_SHARES", (0.05, 0.9, 0.05))  # demonstrations of another place are as many
    policy = run.policy("sft").eval()
    before, scale = distance(run, policy), policy.scale_head.state_dict()
    scale = {name: value.clone() for name, value in scale.items()}
    correct(run, policy, parameters_of(policy), "")
    assert distance(run, policy) < 0.7 * before
    assert all(torch.equal(value, scale[name]) for name, value in policy.scale_head.state_dict().items())
    logged = [line for line in run.folder.read_metrics("adapted") if "correct" in line]
    assert logged[0]["correct"] > logged[-1]["correct"]


def test_nothing_is_learned_where_all_that_could_be_corrected_is_solved(run, monkeypatch, capsys):
    policy = run.policy("sft").eval()
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    monkeypatch.setattr(correcting, "solved_tasks", lambda *_: [0])
    correct(run, policy, parameters_of(policy), "")
    assert "nothing to correct" in capsys.readouterr().out
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


def test_where_no_success_tells_of_a_place_it_is_said_that_nothing_is_corrected(run, monkeypatch, capsys):
    policy = run.policy("sft").eval()
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    monkeypatch.setattr(correcting, "until_reached", failing)
    correct(run, policy, parameters_of(policy), "")
    assert "nothing to correct, no explored rollout that reaches its goal opens or closes" in capsys.readouterr().out
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


def test_only_scales_that_loop_does_not_exceed_are_asked(run, monkeypatch):
    asked = []

    def noted(run_, number, factors):
        asked.extend(factors)
        return told(run_, number, factors)

    monkeypatch.setattr(correcting, "explored_at", noted)
    Corrections(run, 1)
    assert asked == [0.0, 1.0]
    explored = until_reached(told(run, 1, [0.0]))
    assert (corrected_samples(explored, torch.zeros(len(explored)))["episode"] >= 0).all()


def test_without_greedy_exploration_it_is_refused_before_any_work_but_not_where_nothing_is_adapted():
    with pytest.raises(ValueError, match=r"keeps what greedy rollouts do: explore.scale_factors must hold 0, got 1"):
        check_config(dataclasses.replace(SMALL, adapt=config.Adapt(steps=1, correct_steps=5)))
    check_config(dataclasses.replace(SMALL, adapt=config.Adapt(steps=0, correct_steps=5)))
