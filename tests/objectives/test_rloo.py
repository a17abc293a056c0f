"""The leave-one-out advantage against a loop over World-Env Eq. 4."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from worldenv_trl.objectives import rloo_advantage


@pytest.mark.parametrize("shape", [(2,), (5,), (3, 8), (2, 3, 4)])
def test_each_return_is_compared_with_the_mean_of_the_others(shape):
    returns = torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = torch.empty_like(returns)
    for group, row in zip(expected.view(-1, shape[-1]), returns.view(-1, shape[-1]), strict=True):
        for n in range(shape[-1]):
            group[n] = row[n] - sum(row[m] for m in range(shape[-1]) if m != n) / (shape[-1] - 1)
    assert_close(rloo_advantage(returns), expected, rtol=0, atol=1e-12)


def test_advantages_sum_to_zero_in_every_group_and_keep_their_units():
    returns = torch.rand(6, 8, dtype=torch.float64)
    assert_close(rloo_advantage(returns).sum(-1), torch.zeros(6, dtype=torch.float64), rtol=0, atol=1e-12)
    assert_close(rloo_advantage(10 * returns), 10 * rloo_advantage(returns))


def test_equal_returns_teach_nothing():
    assert not rloo_advantage(torch.ones(3, 4)).any()


@pytest.mark.parametrize("shape", [(), (1,), (4, 1)])
def test_a_group_of_one_is_refused(shape):
    with pytest.raises(ValueError, match="at least 2 rollouts"):
        rloo_advantage(torch.zeros(shape))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_return_that_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match="1 of 4 are not"):
        rloo_advantage(torch.tensor([[0.0, 1.0], [value, 1.0]]))
