from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Laplace
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl.policies import ChunkLaplace, IndependentLaplace


@pytest.fixture
def distribution():
    generator = torch.Generator().manual_seed(0)
    loc = torch.randn(4, 8, 7, generator=generator)
    return ChunkLaplace(loc, torch.rand(4, 8, 7, generator=generator) + 0.05)


def test_all_steps_of_a_chunk_are_displaced_alike_each_dimension_and_row_for_itself(distribution):
    torch.manual_seed(0)
    away = distribution.sample() - distribution.loc
    torch.testing.assert_close(away, away[:, :1].expand_as(away))
    assert len(away[:, 0].flatten().unique()) == 4 * 7


def test_a_chunk_goes_as_far_astray_as_one_of_independent_steps():
    torch.manual_seed(0)
    loc, scale = torch.zeros(50_000, 8, 7), torch.linspace(0.02, 0.5, 7)
    shifted, independent = ChunkLaplace(loc, scale).sample().sum(1), IndependentLaplace(loc, scale).sample().sum(1)
    torch.testing.assert_close(shifted.std(0), math.sqrt(16) * scale, rtol=0.02, atol=0)  # 8 draws of variance 2 s^2
    torch.testing.assert_close(shifted.std(0), independent.std(0), rtol=0.02, atol=0)


def test_the_chunks_mean_is_scored_with_the_density_of_the_shift(distribution):
    value = torch.randn(4, 8, 7, generator=torch.Generator().manual_seed(1))
    scale = distribution.scale.mean(1) / math.sqrt(8)
    each = Laplace(distribution.loc.mean(1), scale).log_prob(value.mean(1))  # [4, 7]
    for event_dims, wanted in (
        (0, each[:, None].expand(4, 8, 7)),
        (1, each.sum(-1)[:, None].expand(4, 8)),
        (2, each.sum(-1)),
    ):
        of = ChunkLaplace(distribution.loc, distribution.scale, event_dims)
        torch.testing.assert_close(of.log_prob(value), wanted)
        assert of.entropy().shape == wanted.shape
    torch.testing.assert_close(distribution.entropy()[:, 0], Laplace(torch.zeros(4, 7), scale).entropy().sum(-1))


def test_the_score_is_that_of_a_shift_common_to_all_steps(distribution):
    """The log-probability rises by as much for a shift of any one step's mean as for an eighth of it of all."""
    loc = distribution.loc.clone().requires_grad_()
    ChunkLaplace(loc, distribution.scale).log_prob(distribution.sample())[:, 0].sum().backward()
    torch.testing.assert_close(loc.grad, loc.grad[:, :1].expand_as(loc))
    torch.testing.assert_close(loc.grad.sum(1).abs(), 1 / distribution.noise_scale[:, 0])


def test_samples_of_a_shape_carry_gradients_and_have_the_variance():
    torch.manual_seed(0)
    loc, scale = torch.zeros(8, 7, requires_grad=True), torch.full((7,), 0.3, requires_grad=True)
    distribution = ChunkLaplace(loc, scale)
    samples = distribution.rsample((100_000,))
    assert samples.shape == (100_000, 8, 7)
    torch.testing.assert_close(samples.var(0), distribution.variance, rtol=0.05, atol=0)
    samples.sum().backward()
    assert loc.grad.abs().min() > 0 and scale.grad.abs().min() > 0


def test_without_exploration_the_chunk_is_the_location(distribution):
    assert torch.equal(distribution.mode, distribution.loc)
    assert torch.equal(distribution.deterministic_sample, distribution.loc)


def test_of_rows_shared_by_processes_each_draws_its_own(distribution):
    from worldenv_trl.row_share import row_share

    torch.manual_seed(3)
    whole = distribution.sample()
    for rank in (0, 1):
        part = ChunkLaplace(distribution.loc[2 * rank : 2 * rank + 2], distribution.scale[2 * rank : 2 * rank + 2])
        torch.manual_seed(3)
        with row_share(rank, 2):
            assert torch.equal(part.sample(), whole[2 * rank : 2 * rank + 2])


@pytest.mark.parametrize(("shape", "event_dims"), [((7,), 1), ((8, 7), 3), ((8, 7), -1)])
def test_what_is_no_chunk_is_refused(shape, event_dims):
    with pytest.raises(ValueError, match="event_dims"):
        ChunkLaplace(torch.zeros(shape), torch.ones(shape), event_dims)


def test_the_actor_samples_and_scores_with_its_noise():
    from tensordict import TensorDict

    from worldenv_trl import keys
    from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor, policy_actor

    torch.manual_seed(0)
    policy = OFTPolicy(OFTConfig(instructions=("open the drawer",)))
    actor = policy_actor(policy, noise="chunk", scale_factor=2.0)
    observation = {"image": torch.zeros(3, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(3, 7)}
    batch = TensorDict({"observation": observation, "language_instruction": "open the drawer"}, [3])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        out = actor(batch.clone())
    found = ChunkLaplace(out[keys.LOC], out[keys.SCALE])
    torch.testing.assert_close(out[keys.LOG_PROBS], found.log_prob(out[keys.CHUNK]))
    away = out[keys.CHUNK] - out[keys.LOC]
    torch.testing.assert_close(away, away[:, :1].expand_as(away))
    with pytest.raises(ValueError, match="noise must be one of step, chunk, got 'pink'"):
        laplace_actor(policy, noise="pink")
