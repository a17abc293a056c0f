"""LOOP over a baseline that its waves teach: what it may know, and that it learns what can be seen."""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from small_run import SMALL
from swaps.mlp_policy import MLPConfig, MLPPolicy
from tensordict import TensorDict

import baseline
from baseline import LearnedBaseline
from config import PostTrain
from parts import COMPACT
from post_train import post_train
from stages import open_run
from worldenv_trl import keys
from worldenv_trl.policies import Hidden, OFTConfig, OFTPolicy

SETTINGS = dataclasses.replace(SMALL, max_steps=24, post_train=PostTrain(baseline="learned"))
G, N, T = 24, 4, 3


def small_policy() -> OFTPolicy:
    torch.manual_seed(0)
    return OFTPolicy(OFTConfig(instructions=("do it",), image_size=16, dim=32, depth=1)).eval()


def wave(seed: int = 0, length: int = T) -> tuple[TensorDict, torch.Tensor]:
    """A wave whose rollouts stand far to the right after the first decision where they are to succeed."""
    generator = torch.Generator().manual_seed(seed)
    shape = (G, N, length)
    returns = (torch.rand(G, N, generator=generator) < 0.5).float()
    out = TensorDict(batch_size=shape)
    out["observation", "image"] = torch.zeros(*shape, 3, 16, 16, dtype=torch.uint8)
    out[keys.STATE] = torch.randn(*shape, 7, generator=generator)
    out[keys.STATE][:, :, 1:, 0] = 10 * returns[..., None] - 5
    out[keys.INSTRUCTION] = "do it"
    out[keys.TASK_ID] = torch.zeros(*shape, 1, dtype=torch.int64)
    out[keys.NUM_STEPS] = (8 * torch.arange(length))[:, None].expand(*shape, 1)
    out[keys.MASK] = torch.ones(shape, dtype=torch.bool)
    return out, returns


@pytest.mark.parametrize("waves_before", [0, 1])
def test_a_group_is_not_judged_by_what_it_has_taught_itself(monkeypatch, waves_before):
    """In the first wave the half of the groups that it belongs to is judged by the other half, later ones by those
    before."""
    monkeypatch.setattr(baseline, "_STEPS", 20)
    said = []
    monkeypatch.setattr(baseline, "baseline_advantage", lambda returns, values, *_: said.append(values) or values)
    for changed in (False, True):
        torch.manual_seed(3)
        learned = LearnedBaseline(small_policy(), SETTINGS)
        for number in range(waves_before):
            learned.advantage(*wave(number + 1))
        shown, returns = wave()
        returns[0, 0] = returns[0, 0] if not changed else 1 - returns[0, 0]
        learned.advantage(shown, returns)
    before, after = said[waves_before], said[-1]
    assert torch.equal(before[::2], after[::2])  # its own half
    assert torch.equal(before, after) == bool(waves_before)  # the other one learned from it, or nobody yet


def test_the_grasp_that_decides_is_credited_and_nothing_else():
    """Whether a rollout succeeds is seen from its second decision on: the first one has decided it."""
    settings = dataclasses.replace(SETTINGS.post_train, baseline_lambda=0.7, standardize=False)
    learned = LearnedBaseline(small_policy(), dataclasses.replace(SETTINGS, post_train=settings))
    for seed in range(3):
        shown, returns = wave(seed)
        advantage = learned.advantage(shown, returns)
    first, later = advantage[:, :, 0], advantage[:, :, 1:]
    assert ((first > 0) == (returns > 0)).all() and first.abs().mean() > 0.35
    assert later.abs().mean() < 0.1
    assert learned.explained > 0.5


def test_a_policy_that_gives_nothing_away_is_judged_by_its_hand():
    torch.manual_seed(0)
    policy = MLPPolicy(MLPConfig(instructions=("do it",), image_size=16)).eval()
    assert not isinstance(policy, Hidden)
    learned = LearnedBaseline(policy, SETTINGS)
    for seed in range(3):
        learned.advantage(*wave(seed))
    assert learned.explained > 0.5


def test_advantages_have_the_spread_of_one_and_end_with_the_rollout():
    learned = LearnedBaseline(small_policy(), dataclasses.replace(SETTINGS, max_steps=40))
    shown, returns = wave()
    shown[keys.MASK][0, 0, 1:] = False
    advantage = learned.advantage(shown, returns)
    assert advantage.shape == (G, N, 5)  # as many as a rollout can have
    assert not advantage[0, 0, 1:].any() and not advantage[..., T:].any()
    assert advantage[..., :T][shown[keys.MASK]].std().item() == pytest.approx(1, abs=1e-3)


def test_it_continues_where_it_was(monkeypatch):
    monkeypatch.setattr(baseline, "_DECISIONS", 100)  # fewer than two waves have
    ran, continued = (LearnedBaseline(small_policy(), SETTINGS) for _ in range(2))
    for seed in range(2):
        ran.advantage(*wave(seed))
    continued.load_state_dict(copy.deepcopy(ran.state_dict()))
    random, found = torch.get_rng_state(), []
    for each in (ran, continued):
        torch.set_rng_state(random)
        found.append([each.advantage(*wave(seed)) for seed in (2, 3)])
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))


def test_before_its_first_wave_there_is_nothing_to_continue():
    learned = LearnedBaseline(small_policy(), SETTINGS)
    learned.load_state_dict(learned.state_dict())
    assert learned.advantage(*wave()).isfinite().all()


def test_loop_with_heads_alone_leaves_the_rest_as_it_was(tiny):
    settings = PostTrain(
        iterations=2,
        groups=2,
        group_size=2,
        env="tabletop",
        probe_every=0,
        lora_rank=0,
        lora_lr=0.0,
        baseline="learned",
    )
    run = open_run(dataclasses.replace(tiny, post_train=settings))
    torch.manual_seed(0)
    COMPACT.policy.make(run.config).save_pretrained(run.folder.checkpoint("sft"))
    post_train(run, "sft", "post_train", "", returns_of=lambda wave: wave[keys.CHUNK][..., 0].mean((-1, -2)))
    before, after = (run.policy(name).state_dict() for name in ("sft", "post_train"))
    moved = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert moved <= {"loc_head", "follow_head", "scale_head"} and "loc_head" in moved
    assert all("explained" in line for line in run.folder.read_metrics("post_train"))
