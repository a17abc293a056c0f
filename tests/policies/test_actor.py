from __future__ import annotations

import pytest
import torch
from observations import observed, oft_policy
from tensordict import TensorDict
from torch.distributions import Laplace
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss, ClipPPOLoss

from worldenv_trl.keys import ACTION_IS_PAD, ADVANTAGE, CHUNK, LOC, LOG_PROBS, LOG_SCALE, SCALE
from worldenv_trl.policies import LaplaceActor, laplace_actor, likelihood_actor, scale_bounds


@pytest.fixture
def policy():
    return oft_policy(head_dim=32)


@pytest.fixture
def batch() -> TensorDict:
    return observed()


def told(policy, batch: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
    out = policy(batch.copy())
    return out[LOC], out[LOG_SCALE]


def expert(batch: TensorDict) -> TensorDict:
    generator = torch.Generator().manual_seed(2)
    td = batch.copy()
    td[CHUNK] = torch.rand(6, 8, 7, generator=generator) * 2 - 1
    td[ACTION_IS_PAD] = torch.arange(8) >= torch.tensor([8, 8, 3, 5, 1, 8])[:, None]
    return td


def test_the_chunk_is_scored_with_the_density_it_was_drawn_from(policy, batch):
    actor = laplace_actor(policy, scale_factor=1.5)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        out = actor(batch)
    loc, log_scale = told(policy, batch)
    scale = log_scale.clamp(-4.0, -1.5).exp() * 1.5
    assert torch.equal(out[LOC], loc)
    assert torch.equal(out[LOG_SCALE], log_scale)
    torch.testing.assert_close(out[SCALE], scale)
    torch.testing.assert_close(out[LOG_PROBS], Laplace(loc, scale).log_prob(out[CHUNK]).sum(-1))
    torch.testing.assert_close(actor.get_dist(batch).log_prob(out[CHUNK]), out[LOG_PROBS])
    assert not torch.equal(out[CHUNK], loc)


def test_without_exploration_the_chunk_is_the_location(policy, batch):
    out = laplace_actor(policy)(batch)
    assert torch.equal(out[CHUNK], out[LOC])


def test_log_scales_outside_the_bounds_are_clamped(policy, batch):
    torch.nn.init.constant_(policy.scale_head.linear_out.bias, -9.0)
    out = laplace_actor(policy, log_scale_bounds=(-4.0, -1.5))(batch)
    torch.testing.assert_close(out[SCALE], torch.full_like(out[SCALE], -4.0).exp())


def test_each_action_dimension_can_have_bounds_of_its_own(policy, batch):
    torch.nn.init.constant_(policy.scale_head.linear_out.bias, -9.0)
    low = torch.tensor([-3.0, -3.0, -3.0, -5.0, -5.0, -5.0, -2.0])
    out = laplace_actor(policy, log_scale_bounds=(low.tolist(), -1.0), scale_factor=2.0)(batch)
    torch.testing.assert_close(out[SCALE], 2 * low.exp().expand_as(out[SCALE]))
    with pytest.raises(ValueError, match="low < high"):
        laplace_actor(policy, log_scale_bounds=(low.tolist(), -2.5))


def test_exploration_is_bounded_below_by_the_floor_and_by_a_share_of_the_range(policy, batch):
    policy.action_range.copy_(torch.tensor([0.8, 0.1, 0.1, 0.8, 0.001, 0.001, 1.0]))
    low, high = scale_bounds(policy, floor=(0.04, 0.0025, 0.15), share=0.125)
    expected = torch.tensor([0.1, 0.04, 0.04, 0.1, 0.0025, 0.0025, 0.15])
    torch.testing.assert_close(torch.tensor(low).exp(), expected)
    assert high == -0.8971199989318848  # a unit above the gripper's
    torch.nn.init.constant_(policy.scale_head.linear_out.bias, -20.0)
    out = laplace_actor(policy, log_scale_bounds=(low, high))(batch)
    torch.testing.assert_close(out[SCALE], expected.expand_as(out[SCALE]))


def test_the_upper_bound_is_minus_one_and_a_half_unless_a_floor_is_close(policy):
    policy.action_range.fill_(0.1)
    assert scale_bounds(policy, floor=(0.01, 0.01, 0.01), share=0.5)[1] == -1.5


@pytest.mark.parametrize(("settings", "message"), [({"floor": (0.1, 0.0, 0.1)}, "floor"), ({"share": 1.5}, "share")])
def test_bounds_of_exploration_that_cannot_be_are_named(policy, settings, message):
    with pytest.raises(ValueError, match=f"{message} must"):
        scale_bounds(policy, **settings)


def test_the_actor_hands_out_the_policy_that_it_was_given(policy):
    actor = laplace_actor(policy)
    assert isinstance(actor, LaplaceActor) and actor.policy is policy
    assert actor.in_keys == policy.in_keys
    with pytest.raises(TypeError, match="got Linear"):
        laplace_actor(torch.nn.Linear(2, 2))


def test_a_mean_of_the_weights_is_a_policy(policy, batch):
    mean = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(0.5))
    with torch.no_grad():
        policy.loc_head.linear_out.bias += 1.0
    for _ in range(2):  # the first update copies
        mean.update_parameters(policy)
        with torch.no_grad():
            policy.loc_head.linear_out.bias += 1.0
    actor = laplace_actor(mean.module)
    assert actor.policy is mean.module
    torch.testing.assert_close(actor(batch.copy())[LOC] + 1.5, told(policy, batch)[0])


@pytest.mark.parametrize(("event_dims", "shape"), [(0, (6, 8, 7)), (1, (6, 8)), (2, (6,))])
def test_event_dims_set_the_shape_of_the_log_probs(policy, batch, event_dims, shape):
    assert laplace_actor(policy, event_dims=event_dims)(batch)[LOG_PROBS].shape == shape


@pytest.mark.parametrize("functional", [True, False])
def test_a_new_scale_factor_reaches_a_loss_already_built(policy, batch, functional):
    actor = laplace_actor(policy)
    loss = ClipPPOLoss(actor, None, entropy_bonus=False, functional=functional)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        td = actor(batch.clone())
    td[ADVANTAGE] = torch.ones(6, 1)
    loss.set_keys(action=CHUNK, sample_log_prob=LOG_PROBS)
    assert loss(td)["kl_approx"].abs() < 1e-5
    actor.set_scale_factor(3.0)
    assert actor.scale_factor == pytest.approx(3.0)
    assert loss(td)["kl_approx"].abs() > 0.1


@pytest.mark.parametrize("scale_factor", [0.0, -1.0, float("nan")])
def test_a_scale_factor_that_is_not_positive_is_refused(policy, scale_factor):
    with pytest.raises(ValueError, match="scale_factor must be positive"):
        laplace_actor(policy, scale_factor=scale_factor)


def test_l1_cloning_is_the_mean_absolute_error_over_unpadded_steps(policy, batch):
    loss = BCLoss(laplace_actor(policy), loss_function="l1")
    loss.set_keys(action=CHUNK, pad_mask=ACTION_IS_PAD)
    td = expert(batch)
    loc, _ = told(policy, td)
    reference = (loc - td[CHUNK]).abs()[~td[ACTION_IS_PAD]].mean()
    torch.testing.assert_close(loss(td)["loss_bc"], reference)


def test_the_scale_stage_is_the_laplace_likelihood_and_trains_only_the_scale_head(policy, batch):
    policy.requires_grad_(False)
    for parameter in policy.scale_parameters():
        parameter.requires_grad_(True)
    loss = BCLoss(likelihood_actor(policy))
    loss.set_keys(action=CHUNK, pad_mask=ACTION_IS_PAD)
    td = expert(batch)
    value = loss(td)["loss_bc"]
    loc, log_scale = told(policy, td)
    nll = ((td[CHUNK] - loc).abs() / log_scale.exp() + log_scale + torch.tensor(2.0).log()).sum(-1)
    torch.testing.assert_close(value, nll[~td[ACTION_IS_PAD]].mean())
    value.backward()
    assert all(p.grad is not None for p in policy.scale_parameters())
    others = {id(p) for p in policy.parameters()} - {id(p) for p in policy.scale_parameters()}
    assert others and all(p.grad is None for p in policy.parameters() if id(p) in others)


def test_maximising_the_likelihood_finds_the_mean_absolute_error(policy, batch):
    policy.requires_grad_(False)
    for parameter in policy.scale_parameters():
        parameter.requires_grad_(True)
    loss = BCLoss(likelihood_actor(policy))
    loss.set_keys(action=CHUNK)
    td = expert(batch)
    with torch.no_grad():
        loc, _ = told(policy, td)
    td[CHUNK] = loc + 0.1 * torch.tensor([1.0, -1.0]).repeat(4)[:, None]
    optimizer = torch.optim.Adam(policy.scale_parameters(), 3e-3)
    for _ in range(120):
        optimizer.zero_grad()
        loss(td)["loss_bc"].backward()
        optimizer.step()
    _, log_scale = told(policy, td)
    torch.testing.assert_close(log_scale.exp(), torch.full_like(log_scale, 0.1), rtol=0.15, atol=0)


@pytest.mark.parametrize("functional", [True, False])
def test_a_policy_loss_on_lora_reaches_adapters_and_heads_only(policy, batch, functional):
    policy.post_training_parameters(2)
    actor = laplace_actor(policy)
    loss = ClipPPOLoss(actor, None, entropy_bonus=False, functional=functional)
    loss.set_keys(action=CHUNK, sample_log_prob=LOG_PROBS)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        td = actor(batch.clone())
    td[ADVANTAGE] = torch.randn(6, 1, generator=torch.Generator().manual_seed(0))
    loss(td)["loss_objective"].backward()
    for name, parameter in policy.named_parameters():
        assert (parameter.grad is not None) == ("lora_" in name or "_head." in name), name
