"""Successes played again, moved aside, against the physics that they were recorded in."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from small_run import small_untrained
from tensordict import TensorDict
from test_resumed_recordings import Interrupted, interrupt, result

import config
import explore as explore_stage
import replayed
from demonstrate import demonstrate
from explore import explore, own_episodes, waves_per_scale
from replayed import MOVED_IN, Successes, moved_aside, replays_per_task
from stage_plan import explored
from stages import rerun
from worldenv_trl import keys
from worldenv_trl.data import episodes_from_rollouts
from worldenv_trl.record import read_rollouts

TASKS = config.GOAL_TASKS[1:]
SHIFT = 0.04


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Demonstrations of two tasks, and an untrained policy, which succeeds at nothing."""
    run = small_untrained(
        tmp_path_factory.mktemp("replayed"),
        tasks=TASKS,
        max_steps=40,
        checkpoint_minutes=0.0,
        demonstrate=config.Demonstrate(episodes_per_task=3),
        explore=config.Explore(
            episodes_per_task=8, num_envs=3, scale_factors=(0.0,), replay_share=0.5, replay_shift_m=SHIFT
        ),
    )
    demonstrate(run)
    yield run
    run.close()


@pytest.fixture
def demonstrated(run, monkeypatch):
    """Exploration takes the demonstrations for successes of its own."""
    shown = read_rollouts(run.folder.rollouts("demonstrations"))
    found = Successes(40)
    found.note(shown)
    monkeypatch.setattr(explore_stage, "Successes", lambda _: found)
    return shown


def with_shift(run, shift: float):
    settings = dataclasses.replace(run.config.explore, replay_shift_m=shift)
    return dataclasses.replace(run, config=dataclasses.replace(run.config, explore=settings))


def replays(run):
    """The rollouts behind the policy's own."""
    own = own_episodes(run.config.explore, len(TASKS))
    every = read_rollouts(run.folder.rollouts("explore"))
    assert len(every) == explored(run.config) == own + 2 * 4
    return every[own:]


def paths(rollouts) -> torch.Tensor:
    """Where the hand is commanded to be, [n, T + 1, 3]."""
    return episodes_from_rollouts(rollouts)["kinematic_states"][..., 7:10]


def test_where_nothing_is_moved_the_same_happens_again(run, demonstrated):
    explore(with_shift(run, 0.0))
    again = replays(run)
    assert (again["next", keys.SUCCESS].squeeze(-1) & again[keys.MASK]).any(-1).all()
    assert again[keys.TASK_ID][:, 0, 0].tolist() == [0] * 4 + [1] * 4
    contexts = demonstrated[keys.CONTEXT_ID][:, 0, 0].tolist()
    for rollout in again:
        source = demonstrated[contexts.index(int(rollout[keys.CONTEXT_ID][0, 0]))]
        steps = int(source[keys.MASK].sum())
        for name in (keys.ACTION, ("next", keys.KINEMATIC_STATE), ("next", "observation", "image")):
            assert torch.equal(rollout[name][:steps], source[name][:steps])


def test_the_hand_is_moved_and_stays_beside_the_path(run, demonstrated, monkeypatch):
    monkeypatch.setattr(replayed, "_LATE", 0.0)
    explore(run)
    moved, contexts = replays(run), demonstrated[keys.CONTEXT_ID][:, 0, 0].tolist()
    here, source = paths(moved), paths(demonstrated)
    distances = []
    for rollout, path in zip(moved, here, strict=True):
        row = contexts.index(int(rollout[keys.CONTEXT_ID][0, 0]))
        steps = int(demonstrated[row][keys.MASK].sum())
        apart = (path[: steps + 1] - source[row][: steps + 1])[MOVED_IN:]
        assert torch.allclose(apart, apart[:1].expand_as(apart), atol=2e-3)  # within what the workspace leaves
        distances.append(float(apart[0].norm()))
    assert max(distances) <= SHIFT + 1e-6 and max(distances) > SHIFT / 4
    lines = [line for line in run.folder.read_metrics("explore") if "replay_shift_m" in line]
    succeeded = (moved["next", keys.SUCCESS].squeeze(-1) & moved[keys.MASK]).any(-1)
    assert lines[-1]["episodes"] == 8
    assert lines[-1]["success"] == pytest.approx(succeeded.float().mean().item())


def test_interrupted_it_goes_on_in_the_same_file(run, demonstrated, monkeypatch):
    def explored_anew():
        rerun("explore", explore, run)
        shown = run.folder.rollouts("demonstrations").rename(run.folder.path / "shown.mcap")
        out = result(run, "explore")
        shown.rename(run.folder.rollouts("demonstrations"))
        return out

    straight = explored_anew()
    with monkeypatch.context() as patch:
        interrupt(patch, 5)  # the second wave of those that are played again
        with pytest.raises(Interrupted):
            rerun("explore", explore, run)
    monkeypatch.setattr(explore_stage, "Successes", Successes)  # the checkpoint has them
    assert explored_anew() == straight


def test_actions_move_the_hand_by_what_is_asked():
    actions = torch.zeros(2, 20, 7)
    moved = moved_aside(actions, torch.tensor([[0.03, -0.06, 0.02], [0.0, 0.0, 0.0]]))
    added = keys.POSITION_STEP * moved.sum(1)
    assert torch.allclose(added[0], torch.tensor([0.03, -0.06, 0.02, 0, 0, 0, 0]), atol=1e-6)
    assert not moved[1].any() and not moved[0, MOVED_IN:].any()
    full = moved_aside(torch.ones(1, 20, 7), torch.tensor([[0.1, 0.1, 0.1]]))
    assert full.max() == 1  # an action goes no further


def test_it_may_begin_on_the_way(run, demonstrated, monkeypatch):
    monkeypatch.setattr(replayed, "_LATE", 1.0)
    explore(run)
    moved, contexts = replays(run), demonstrated[keys.CONTEXT_ID][:, 0, 0].tolist()
    begun = []
    for rollout in moved:
        source = demonstrated[contexts.index(int(rollout[keys.CONTEXT_ID][0, 0]))]
        steps = int(source[keys.MASK].sum())  # the last one reaches the goal
        differs = (rollout[keys.ACTION][:steps] != source[keys.ACTION][:steps]).any(-1)
        begun.append(int(differs.long().argmax()) if differs.any() else steps)
        assert not differs[begun[-1] + MOVED_IN :].any()
        assert not (rollout[keys.ACTION][:steps] != source[keys.ACTION][:steps])[:, 3:].any()
    assert len(set(begun)) > 3 and max(begun) > MOVED_IN


def test_actions_are_moved_from_where_it_begins():
    moved = moved_aside(torch.zeros(2, 30, 7), torch.full((2, 3), 0.06), torch.tensor([0, 15]))
    assert moved[0].any(-1).nonzero().squeeze(-1).tolist() == list(range(MOVED_IN))
    assert moved[1].any(-1).nonzero().squeeze(-1).tolist() == list(range(15, 15 + MOVED_IN))
    assert torch.allclose(keys.POSITION_STEP * moved.sum(1)[:, :3], torch.full((2, 3), 0.06))


def test_without_a_success_nothing_is_played_again(run):
    with pytest.warns(
        UserWarning, match=f"no explored rollout of {TASKS[0]} reached the goal: none is played again, 4"
    ):
        explore(run)
    own = own_episodes(run.config.explore, len(TASKS))
    assert len(read_rollouts(run.folder.rollouts("explore"))) == own


def test_successes_survive_a_checkpoint(demonstrated):
    found = Successes(40)
    found.note(demonstrated)
    again = Successes(40)
    again.load_state_dict(found.state_dict())
    again.note(demonstrated)
    for number in (0, 1):
        before, after = found.of_task(number), again.of_task(number)
        assert len(before) == 3 and len(after) == 6
        assert torch.equal(after["actions"][:3], before["actions"])
    assert Successes(40).state_dict() == {}


@pytest.mark.parametrize(("share", "own", "again"), [(0.0, 8, 0), (0.25, 6, 2), (0.5, 4, 4)])
def test_the_share_is_one_of_the_episodes_that_are_asked_for(share, own, again):
    settings = config.Explore(episodes_per_task=8, num_envs=1, scale_factors=(0.0, 1.0), replay_share=share)
    assert replays_per_task(settings) == again
    assert 2 * waves_per_scale(settings, 3) == 3 * own


def test_as_far_in_every_direction():
    settings = config.Explore(episodes_per_task=4000, num_envs=4000, replay_share=1 - 1e-9, replay_shift_m=0.05)
    found = Successes(20)
    found._parts = [torch.stack([_still(), _still()])]
    (wave,) = replayed._drawn(found.of_task(0), settings, torch.Generator().manual_seed(0))
    shift = keys.POSITION_STEP * wave["actions"].sum(1)[:, :3]
    far = shift.norm(dim=-1)
    assert far.max() <= 0.05 + 1e-6 and float(far.mean()) == pytest.approx(0.025, abs=1e-3)
    assert torch.allclose(shift.mean(0), torch.zeros(3), atol=2e-3)
    # Of a direction in space every coordinate is uniform in [-1, 1] (Archimedes).
    for coordinate in (shift / far.unsqueeze(-1)).unbind(-1):
        assert all(abs((coordinate < bound).float().mean() - (1 + bound) / 2) < 0.03 for bound in (-0.5, 0.0, 0.5))


def _still():
    return TensorDict(
        {
            "actions": torch.zeros(20, 7),
            keys.CONTEXT_ID: torch.tensor(0),
            keys.TASK_ID: torch.tensor(0),
            "reached": torch.tensor(8),
        },
        [],
    )
