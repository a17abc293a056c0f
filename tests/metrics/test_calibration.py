"""Calibration, against numbers by hand and a loop over bins."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from worldenv_trl.metrics import calibration_slope, expected_calibration_error


def slow_error(probability, label, bins):
    error = 0.0
    for number in range(bins):
        low, high = number / bins, (number + 1) / bins
        inside = [
            (p, y)
            for p, y in zip(probability.tolist(), label.tolist(), strict=True)
            if low < p <= high or (number == 0 and p == 0)
        ]
        if inside:
            promised, came = (sum(values) / len(inside) for values in zip(*inside, strict=True))
            error += len(inside) / len(label) * abs(promised - came)
    return error


@pytest.mark.parametrize("bins", [1, 4, 10])
def test_the_error_is_that_of_a_loop_over_bins(bins):
    generator = torch.Generator().manual_seed(bins)
    probability = torch.rand(3, 50, generator=generator)
    label = torch.rand(3, 50, generator=generator) < probability
    expected = [slow_error(probability[row], label[row], bins) for row in range(3)]
    assert expected_calibration_error(probability, label, bins).tolist() == pytest.approx(expected, abs=1e-6)


def test_a_promise_that_is_kept_has_no_error():
    probability = torch.tensor([0.25] * 4 + [0.75] * 4)
    label = torch.tensor([True, False, False, False, True, True, True, False])
    assert expected_calibration_error(probability, label).item() == pytest.approx(0)
    assert calibration_slope(probability, label).item() == pytest.approx(1)


def test_errors_of_opposite_sign_in_different_bins_do_not_cancel():
    probability, label = torch.tensor([0.0, 1.0]), torch.tensor([True, False])
    assert expected_calibration_error(probability, label).item() == 1
    assert expected_calibration_error(probability, label, bins=1).item() == 0


def test_the_slope_is_that_of_least_squares():
    generator = torch.Generator().manual_seed(0)
    probability = torch.rand(2, 30, generator=generator)
    label = torch.rand(2, 30, generator=generator) < 0.5
    expected = [np.polyfit(probability[row], label[row].float(), 1)[0] for row in range(2)]
    assert calibration_slope(probability, label).tolist() == pytest.approx(expected, abs=1e-6)
    assert math.isnan(calibration_slope(torch.full((5,), 0.3), torch.tensor([True, False, True, False, True])))


def test_what_is_no_probability_is_refused():
    label = torch.tensor([True, False])
    with pytest.raises(ValueError, match="must lie in"):
        expected_calibration_error(torch.tensor([0.5, 1.5]), label)
    with pytest.raises(ValueError, match="n >= 1"):
        calibration_slope(torch.tensor([0.5]), label)
    with pytest.raises(ValueError, match="bins must be at least 1, got 0"):
        expected_calibration_error(torch.tensor([0.5, 0.5]), label, bins=0)
