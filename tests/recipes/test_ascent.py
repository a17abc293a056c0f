"""The slope of success along LOOP's gradient: its gradients, its unit, and one measured for real."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from test_benchmarks import benchmark
from torch.distributions import Laplace, kl_divergence
from torchrl.envs.utils import ExplorationType, set_exploration_type

import config
from demonstrate import demonstrate
from explore import explore
from parts import COMPACT
from run import write_rules
from stages import open_run
from worldenv_trl import keys
from worldenv_trl.policies import OFTConfig, OFTPolicy, policy_actor
from worldenv_trl.reflectors import StopRule

ascent = benchmark("ascent")
G, N, T = 192, 8, 2


@pytest.fixture
def policy() -> OFTPolicy:
    torch.manual_seed(0)
    made = OFTPolicy(OFTConfig(instructions=("do it",), image_size=16, dim=32, depth=1)).eval()
    made.requires_grad_(False)
    return made


@pytest.fixture
def heads(policy) -> list[torch.nn.Parameter]:
    return [parameter.requires_grad_(True) for parameter in policy.post_training_parameters(0)["heads"]]


def lived(policy) -> TensorDict:
    """Groups that stand somewhere at random and act as the policy samples; the last decision of half is cut short."""
    torch.manual_seed(1)
    waves = TensorDict(batch_size=[G, N, T])
    waves["observation", "image"] = torch.randint(0, 256, (G, N, T, 3, 16, 16), dtype=torch.uint8)
    waves[keys.STATE] = torch.randn(G, N, T, 7)
    waves[keys.INSTRUCTION] = "do it"
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        waves = policy_actor(policy)(waves)
    waves[keys.MASK] = torch.ones(G, N, T, dtype=torch.bool)
    waves[keys.MASK][:, 0, 1:] = False
    steps = torch.ones(G, N, T, waves[keys.CHUNK].shape[-2], dtype=torch.bool)
    steps[:, : N // 2, -1, 3:] = False
    waves["next", keys.STEP_MASK] = steps
    return waves


def executed(waves) -> torch.Tensor:
    return (waves["next", keys.STEP_MASK] & waves[keys.MASK].unsqueeze(-1)).float()


def test_gradients_point_where_the_expected_return_rises(policy, heads):
    """Returns are a sum over executed actions, so what is expected is the same sum over the means."""
    waves = lived(policy)
    weights = torch.randn(waves[keys.CHUNK].shape[-2:])
    told = [((waves[key] * weights).sum(-1) * executed(waves)).sum(-1) for key in (keys.CHUNK, keys.LOC)]
    each = ascent.gradients(policy_actor(policy), waves, told[0] - told[1], heads)
    assert not ascent.gradients(policy_actor(policy), waves[:2], torch.zeros(2, N, T), heads).any()
    assert each.shape == (G, sum(parameter.numel() for parameter in heads))
    loc = policy(waves.clone())[keys.LOC]
    truth = torch.cat(
        [part.flatten() for part in torch.autograd.grad(((loc * weights).sum(-1) * executed(waves)).sum(), heads,
                                                        allow_unused=True, materialize_grads=True)]
    )  # fmt: skip
    assert torch.cosine_similarity(each.sum(0), truth, 0) > 0.9
    assert (each.sum(0) @ truth / truth.square().sum()).item() == pytest.approx(1, abs=0.1)


def test_a_unit_is_the_root_of_twice_the_kl_of_a_step(policy, heads):
    waves, direction = lived(policy), torch.randn(sum(parameter.numel() for parameter in heads))
    before = [parameter.detach().clone() for parameter in heads]
    width, double = ascent.widths(policy, waves, torch.stack([direction, 2 * direction]), heads).tolist()
    assert double == pytest.approx(2 * width, rel=0.01)
    assert all(torch.allclose(*pair) for pair in zip(before, heads, strict=True))
    wide, old, size = executed(waves)[::2], waves[::2], 0.01 / width
    with torch.no_grad():
        ascent._move(heads, size * direction)
        loc = policy(old.clone())[keys.LOC]
    kl = kl_divergence(Laplace(old[keys.LOC], old[keys.SCALE]), Laplace(loc, old[keys.SCALE])).sum(-1)
    assert math.sqrt(2 * (kl * wide).sum() / wide.sum()) == pytest.approx(0.01, rel=0.02)


def test_adam_lets_every_parameter_speak_by_its_signal_and_not_by_its_size():
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [1.0, 1.0]])  # the second one's mean is half
    for size in (1.0, 100.0):
        scaled = ascent._scaled(signs * torch.tensor([size, size]))
        assert scaled.tolist() == pytest.approx([1.0, 0.5], rel=0.01)


@pytest.fixture
def run(tiny, monkeypatch):
    """Untrained parts of two tasks, and an exploration of theirs."""
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # so few steps are not enough for the expert
    run = open_run(dataclasses.replace(tiny, tasks=config.GOAL_TASKS[1:]))
    torch.manual_seed(0)
    for name, part in (("sft", "policy"), ("world_model", "world_model"), ("reflector", "reflector")):
        getattr(COMPACT, part).make(run.config).save_pretrained(run.folder.checkpoint(name))
    write_rules(run.folder.checkpoint("reflector"), {"imagined": StopRule(), "real": StopRule()})
    demonstrate(run)
    explore(run)
    yield run
    run.close()


def shown(run, monkeypatch, **settings):
    """The slopes of returns that are a matter of chance."""
    made = ascent._kept

    def by_chance(wave, *others):
        kept = made(wave, *others)
        kept["returns"] = torch.rand(*kept.shape[:2], 1).expand(kept.shape)
        return kept

    monkeypatch.setattr(ascent, "_kept", by_chance)
    return ascent.main(ascent.Settings(run.folder.path, waves=2, **settings))


@pytest.mark.parametrize("imagined", [False, True])
def test_slopes_of_a_run_are_made_of_waves_that_are_lived_once(run, imagined, monkeypatch, capsys):
    rows = shown(run, monkeypatch, imagined=imagined)
    assert [name for name, _ in rows] == [f"{count} | {step}" for count in (2, 4) for step in ("plain", "Adam's")]
    assert [slopes.shape for _, slopes in rows] == [(2, 4), (2, 4), (1, 4), (1, 4)]
    assert all(slopes.isfinite().all() for _, slopes in rows)
    assert ("imagined: mean return" in capsys.readouterr().out) == imagined
    monkeypatch.setattr(ascent, "Waves", None)
    assert len(shown(run, monkeypatch, imagined=imagined)) == len(rows)


def test_groups_that_end_alike_have_no_slope(run):
    with pytest.raises(SystemExit, match=r"directions: rollouts of a group end alike \(mean return 0.000\)"):
        ascent.main(ascent.Settings(run.folder.path, waves=1))


def test_no_waves_are_refused(run):
    with pytest.raises(SystemExit, match="waves must be at least 1, got 0"):
        ascent.main(ascent.Settings(run.folder.path, waves=0))
