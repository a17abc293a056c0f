"""A policy that learns to do on imagined frames what it does on real ones."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from small_run import small_untrained, token_policy

import config
from adapt import Decisions, adapt, sampled_as_in_loop
from checks import check_loop
from demonstrate import demonstrate
from explore import explore
from imagining import imagined
from parts import COMPACT
from physics import exploring_actor
from stages import plan
from worldenv_trl import keys
from worldenv_trl.record import read_rollouts


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """An exploration of three scales of a policy that looks closely, and a world model that has learned nothing."""
    run = small_untrained(
        tmp_path_factory.mktemp("adapt"),
        max_steps=40,
        tasks=config.GOAL_TASKS[1:],
        explore=config.Explore(episodes_per_task=6, num_envs=4, scale_factors=(2.0, 0.0, 1.0)),
        adapt=config.Adapt(steps=150, episodes_per_task=2, batch_size=8, lr=2e-5),
    )
    policy = run.policy("sft")
    with torch.no_grad():
        [*policy.loc_head.modules()][-1].weight *= 20
    policy.save_pretrained(run.folder.checkpoint("sft"))
    demonstrate(run)
    explore(run)
    COMPACT.world_model.make(run.config).save_pretrained(run.folder.checkpoint("world_model"))
    yield run
    run.close()


def distances(run, policy):
    """How far from SFT's means on real frames a policy's are, in SFT's scale: on real frames, and on imagined ones."""
    sft = run.policy("sft").eval()
    torch.manual_seed(0)
    episodes = sampled_as_in_loop(run, 1)
    with run.folder.lasting_scratch() as scratch:
        dreamt = imagined(run, run.world_model(), episodes, "adapted", "explored", scratch)
        decisions = Decisions(episodes, dreamt, sft, run.config.chunk_length)
        decisions.refer(exploring_actor(run.config, sft, 1.0))
        rows, found = torch.arange(len(decisions)), []
        for each in (False, True):
            seen = decisions.seen(rows, dreamt=each)
            with torch.no_grad():
                mean = exploring_actor(run.config, policy, 1.0).get_dist(seen.copy()).loc
            found.append(((mean - seen[keys.REFERENCE_LOC]).abs() / seen[keys.REFERENCE_SCALE]).mean().item())
    return found


def test_the_episodes_are_of_scales_that_loop_samples_with(run):
    every = read_rollouts(run.folder.rollouts("explore"))
    noisiest = every[: len(every) // 3]  # written first
    chosen = sampled_as_in_loop(run, 1)
    assert chosen[keys.TASK_ID].squeeze(-1).tolist() == [0, 0, 1, 1]
    first = noisiest[keys.ACTION][:, 0]
    assert not any(torch.isclose(first, action).all(-1).any() for action in chosen["actions"][:, 0])
    wider = dataclasses.replace(run.config, adapt=dataclasses.replace(run.config.adapt, episodes_per_task=100))
    assert len(sampled_as_in_loop(dataclasses.replace(run, config=wider), 1)) == len(every) * 2 // 3
    never = dataclasses.replace(wider, post_train=dataclasses.replace(wider.post_train, scale_factor=1e-3))
    never = dataclasses.replace(never, explore=dataclasses.replace(never.explore, scale_factors=(2.0, 1.5, 1.0)))
    assert len(sampled_as_in_loop(dataclasses.replace(run, config=never), 1)) == len(every)


def test_decisions_show_both_worlds_at_the_same_steps(run):
    torch.manual_seed(0)
    episodes, sft = sampled_as_in_loop(run, 1), run.policy("sft").eval()
    episodes["length"][0] = 17  # decides at 0, 8 and 16
    with run.folder.lasting_scratch() as scratch:
        dreamt = imagined(run, run.world_model(), episodes, "adapted", "explored", scratch)
        decisions = Decisions(episodes, dreamt, sft, 8)
        assert len(decisions) == 3 + 3 * 5
        rows = torch.arange(5)
        real, other = (decisions.seen(rows, dreamt=each) for each in (False, True))
        steps = torch.tensor([0, 8, 16, 0, 8])
        row = torch.tensor([0, 0, 0, 1, 1])
        assert torch.equal(real[keys.IMAGE], episodes.frames("agentview", row, steps))
        assert torch.equal(other[keys.IMAGE], dreamt.frames("agentview", row, steps))
        assert torch.equal(real[keys.STATE], episodes["states"][row, steps])
        assert torch.equal(real[keys.STATE], other[keys.STATE]) and keys.REFERENCE_LOC not in real.keys(True)
        decisions.refer(exploring_actor(run.config, sft, 1.0))
        with torch.no_grad():
            expected = exploring_actor(run.config, sft, 1.0).get_dist(real.copy()).loc
        found = decisions.seen(rows, dreamt=True)
        torch.testing.assert_close(found[keys.REFERENCE_LOC], expected, atol=1e-5, rtol=1e-4)


def test_imagined_frames_are_answered_like_real_ones(run):
    adapt(run)
    before, after = (distances(run, run.policy(name).eval()) for name in ("sft", "adapted"))
    assert before[0] < 1e-4 < before[1]
    assert max(after) < 0.7 * before[1]
    losses = [line["loss"] for line in run.folder.read_metrics("adapted")]
    assert losses[-1] < losses[0]


def test_the_stage_is_there_when_asked_for_and_loop_begins_with_it(run):
    stages = {stage.name: stage for stage in plan(run.config)}
    assert list(stages)[-3:] == ["adapted", "post_train", "evaluate"]
    assert stages["post_train"].options["source"] == "adapted" and stages["evaluate"].options["before"] == "sft"
    again = dataclasses.replace(run.config, rounds=2)
    sources = [stage.options["source"] for stage in plan(again) if stage.kind in ("adapt", "post_train")]
    assert sources == ["sft", "adapted", "post_train", "adapted_2"]
    without = dataclasses.replace(run.config, adapt=config.Adapt())
    physics = dataclasses.replace(run.config, post_train=dataclasses.replace(run.config.post_train, env="tabletop"))
    assert not {"adapted"} & {stage.name for other in (without, physics) for stage in plan(other)}


def test_what_has_no_mean_cannot_adapt(run):
    with pytest.raises(ValueError, match=r"adapt.steps is for policies with a mean, and Tokens acts by tokens"):
        check_loop(run.config, token_policy())
