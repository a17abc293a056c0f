from __future__ import annotations

import pytest
import torch
from torch.distributions import Laplace
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl.policies import IndependentLaplace


@pytest.fixture
def parameters():
    generator = torch.Generator().manual_seed(0)
    loc = torch.randn(4, 8, 7, generator=generator)
    scale = torch.rand(4, 8, 7, generator=generator) + 0.05
    return loc, scale, torch.randn(4, 8, 7, generator=generator)


@pytest.mark.parametrize("event_dims", [0, 1, 2])
def test_log_prob_and_entropy_are_torchs_laplace_summed_over_the_event(parameters, event_dims):
    loc, scale, value = parameters
    distribution = IndependentLaplace(loc, scale, event_dims)
    reference = Laplace(loc, scale)
    dims = list(range(-event_dims, 0))
    log_prob, entropy = reference.log_prob(value), reference.entropy()
    if dims:
        log_prob, entropy = log_prob.sum(dims), entropy.sum(dims)
    torch.testing.assert_close(distribution.log_prob(value), log_prob)
    torch.testing.assert_close(distribution.entropy(), entropy)


def test_mode_and_deterministic_sample_are_the_location(parameters):
    loc, scale, _ = parameters
    distribution = IndependentLaplace(loc, scale)
    assert torch.equal(distribution.mode, loc)
    assert torch.equal(distribution.deterministic_sample, loc)
    assert torch.equal(distribution.mean, loc)


def test_samples_have_the_scale_as_mean_absolute_deviation():
    torch.manual_seed(0)
    scale = torch.tensor([0.02, 0.5, 3.0])
    samples = IndependentLaplace(torch.ones(3), scale).sample((200_000,))
    torch.testing.assert_close((samples - 1).abs().mean(0), scale, rtol=0.02, atol=0)


def test_samples_carry_gradients_to_loc_and_scale():
    loc, scale = torch.zeros(3, requires_grad=True), torch.ones(3, requires_grad=True)
    IndependentLaplace(loc, scale).rsample().sum().backward()
    assert torch.equal(loc.grad, torch.ones(3))
    assert scale.grad.abs().sum() > 0


@pytest.mark.parametrize("mode", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN])
def test_torchrl_takes_the_location_when_it_does_not_explore(parameters, mode):
    from tensordict import TensorDict
    from tensordict.nn import ProbabilisticTensorDictModule

    loc, scale, _ = parameters
    module = ProbabilisticTensorDictModule(
        in_keys=["loc", "scale"], out_keys=["a"], distribution_class=IndependentLaplace
    )
    with set_exploration_type(mode):
        out = module(TensorDict({"loc": loc, "scale": scale}, [4]))
    assert torch.equal(out["a"], loc)
