"""What returns tell inside groups, against NumPy group by group, and intervals against those that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from worldenv_trl.metrics import group_bootstrap, group_correlations, group_slope


def drawn(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    real = torch.rand(*shape, generator=generator) < 0.5
    return torch.rand(*shape, generator=generator), real


def mean(column):
    return column.mean((-2, -1))


def test_correlations_are_pearsons_of_each_mixed_group():
    returns, real = drawn(5, 20, 8)
    each = group_correlations(returns, real)
    for row in np.ndindex(5, 20):
        expected = np.corrcoef(returns[row], real[row].float())[0, 1] if 0 < real[row].sum() < 8 else np.nan
        assert each[row].item() == pytest.approx(expected, nan_ok=True)


def test_equal_returns_tell_nothing_of_a_mixed_group():
    real = torch.tensor([[True, False, False], [True, True, True]])
    each = group_correlations(torch.full((2, 3), 0.7), real).tolist()
    assert each[0] == 0 and math.isnan(each[1])


def test_the_slope_is_one_regression_with_a_level_for_every_group():
    returns, real = drawn(6, 8)
    levels = np.kron(np.eye(6), np.ones((8, 1)))
    design = np.concatenate([returns.reshape(-1, 1).double().numpy(), levels], 1)
    expected = np.linalg.lstsq(design, real.flatten().double().numpy(), rcond=None)[0][0]
    assert group_slope(returns, real).item() == pytest.approx(expected)
    assert group_slope(real.float(), real).item() == pytest.approx(1)
    assert math.isnan(group_slope(torch.zeros(6, 8), real))


def test_a_figure_stays_and_its_interval_is_that_of_the_mean():
    values = torch.randn(400, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    estimate = group_bootstrap(mean, values, resamples=4000)
    half = 1.96 * values.std().item() / 20
    assert estimate.value == values.mean().item()
    assert (estimate.low, estimate.high) == pytest.approx((estimate.value - half, estimate.value + half), abs=0.008)


def test_whole_groups_are_drawn_again():
    alike = torch.randn(30, 1, generator=torch.Generator().manual_seed(0)).expand(30, 8)
    eight, one = (group_bootstrap(mean, column) for column in (alike, alike[:, :1]))
    assert (eight.low, eight.high) == pytest.approx((one.low, one.high))  # eight copies are not eight samples


def test_strata_keep_their_number():
    strata = torch.tensor([0] * 3 + [1] * 9)
    estimate = group_bootstrap(mean, strata.unsqueeze(-1).double(), strata=strata)
    assert (estimate.low, estimate.value, estimate.high) == (0.75, 0.75, 0.75)


def test_columns_are_drawn_together_and_alike_with_the_same_seed():
    values = torch.randn(20, 2, generator=torch.Generator().manual_seed(0))
    difference = group_bootstrap(lambda first, second: mean(first - second), values, values - 1)
    assert (difference.low, difference.high) == pytest.approx((1, 1))
    assert group_bootstrap(mean, values) == group_bootstrap(mean, values) != group_bootstrap(mean, values, seed=1)


def test_resamples_in_which_the_figure_cannot_be_said_are_left_out():
    column = torch.tensor([[math.nan], [2.0]])
    estimate = group_bootstrap(lambda values: values.squeeze(-1).nanmean(-1), column)
    assert (estimate.low, estimate.value, estimate.high) == (2, 2, 2)


def test_what_cannot_be_drawn_is_refused():
    for columns in ((), (torch.zeros(0, 1),), (torch.zeros(3, 1), torch.zeros(2, 1))):
        with pytest.raises(ValueError, match="same number of groups"):
            group_bootstrap(mean, *columns)
    with pytest.raises(ValueError, match="confidence in"):
        group_bootstrap(mean, torch.zeros(3, 1), confidence=1.0)
    with pytest.raises(ValueError, match=r"must both be \[\*B, G, N\]"):
        group_correlations(torch.zeros(3, 2), torch.zeros(2, 3))
