"""The learned baseline's advantages against loops over their definition, and what its network learns."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch.testing import assert_close

from worldenv_trl.objectives import ValueBaseline, baseline_advantage


def rollouts(count: int = 12, most: int = 6):
    """Returns [K], values [K, T] and masks of rollouts of 1 to T decisions."""
    generator = torch.Generator().manual_seed(0)
    returns = torch.rand(count, dtype=torch.float64, generator=generator)
    values = torch.rand(count, most, dtype=torch.float64, generator=generator)
    length = torch.arange(count) % most + 1
    return returns, values, torch.arange(most) < length[:, None]


@pytest.mark.parametrize("lmbda", [0.0, 0.3, 0.7, 1.0])
def test_each_decision_is_credited_with_the_changes_from_it_on(lmbda):
    returns, values, mask = rollouts()
    expected = torch.zeros_like(values)
    for k in range(len(returns)):
        known = [*values[k, mask[k]].tolist(), returns[k].item()]
        changes = [after - before for before, after in itertools.pairwise(known)]
        for t in range(len(changes)):
            expected[k, t] = sum(lmbda**later * change for later, change in enumerate(changes[t:]))
    assert_close(
        baseline_advantage(returns, values, mask, lmbda), expected, rtol=0, atol=1e-7
    )  # TorchRL discounts in float32


def test_with_lambda_one_it_is_the_return_less_the_value():
    returns, values, mask = rollouts()
    expected = torch.where(mask, returns[:, None] - values, 0.0)
    assert_close(baseline_advantage(returns, values, mask, 1.0), expected, rtol=0, atol=1e-12)


def test_groups_of_rollouts_are_rollouts():
    returns, values, mask = rollouts()
    grouped = baseline_advantage(returns.view(3, 4), values.view(3, 4, -1), mask.view(3, 4, -1), 0.7)
    assert torch.equal(grouped.view(12, -1), baseline_advantage(returns, values, mask, 0.7))


def test_what_lies_outside_the_mask_is_not_read():
    returns, values, mask = rollouts()
    spoilt = torch.where(mask, values, torch.nan)
    assert torch.equal(baseline_advantage(returns, spoilt, mask, 0.7), baseline_advantage(returns, values, mask, 0.7))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r, v, m: (r, v[:, :-1], m, 0.7), "must be \\[\\*B, T\\]"),
        (lambda r, v, m: (r[1:], v, m, 0.7), "must be \\[\\*B, T\\]"),
        (lambda r, v, m: (r, v, m, 1.5), "lmbda must be in \\[0, 1\\], got 1.5"),
        (lambda r, v, m: (r, v, m & False, 0.7), "one at least"),
        (lambda r, v, m: (r, v, m.flip(-1), 0.7), "the first decisions"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        baseline_advantage(*change(*rollouts()))


@pytest.mark.parametrize("sizes", [(0, 8, 0.3), (4, 0, 0.3), (4, 8, 1.0)])
def test_a_network_that_cannot_be_is_refused(sizes):
    with pytest.raises(ValueError, match="must be at least 1"):
        ValueBaseline(*sizes)


def test_it_learns_the_probability_of_success():
    """Outcomes drawn with a known probability, a logistic function of one of the features."""
    torch.manual_seed(0)
    features = torch.randn(4000, 5) * torch.tensor([1.0, 10.0, 1.0, 1e-5, 1.0]) + 3
    truth = (2 * (features[:, 0] - 3)).sigmoid()
    returns = torch.bernoulli(truth)
    value = ValueBaseline(5, width=64, dropout=0.0)
    value.normalize(features)
    optimizer = torch.optim.Adam(value.parameters(), 3e-3)
    for _ in range(400):
        rows = torch.randint(len(features), (256,))
        optimizer.zero_grad()
        value.loss(features[rows], returns[rows]).backward()
        optimizer.step()
    off = (value.eval()(features) - truth).detach().abs().mean().item()
    assert off < 0.05 < 0.25 < (returns.mean() - truth).abs().mean().item()  # what knowing nothing is off by


def test_features_of_any_size_come_to_the_network_alike():
    value = ValueBaseline(3)
    features = torch.randn(500, 3) * torch.tensor([1e-2, 1.0, 1e3]) + torch.tensor([5.0, 0.0, -1e4])
    value.normalize(features)
    shown = (features - value.center) / value.spread
    assert_close(shown.mean(0), torch.zeros(3), atol=1e-3, rtol=0)
    assert_close(shown.std(0), torch.ones(3), atol=0.15, rtol=0)
