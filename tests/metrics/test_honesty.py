from __future__ import annotations

import math

import pytest
import torch

from worldenv_trl.metrics import honesty

IMAGINED = torch.tensor([True, True, True, False, False, True, False, True])
REAL = torch.tensor([True, False, True, True, False, True, False, False])


def test_imagined_success_is_judged_against_the_physics():
    report = honesty(IMAGINED, REAL)  # 3 of 5 imagined successes are real, 3 of 4 real ones are imagined
    assert (report["precision"], report["recall"]) == pytest.approx((3 / 5, 3 / 4))
    assert report["f1"] == pytest.approx(2 / (5 / 3 + 4 / 3))
    assert report["gap"] == pytest.approx(5 / 8 - 4 / 8)
    assert report["gap_low"] < report["gap"] < report["gap_high"]


def test_an_imagination_that_is_right_has_no_gap():
    report = honesty(REAL, REAL)
    assert (report["precision"], report["recall"], report["gap"]) == (1, 1, 0)


def test_an_imagination_that_is_too_kind_has_a_positive_gap():
    assert honesty(torch.ones(8, dtype=torch.bool), REAL)["gap"] == pytest.approx(0.5)


def test_stop_times_are_compared_where_both_succeed():
    imagined_steps, real_steps = torch.tensor([10, 5, 20, 0, 0, 30, 0, 9]), torch.tensor([12, 0, 20, 7, 0, 26, 0, 0])
    report = honesty(IMAGINED, REAL, imagined_steps=imagined_steps, real_steps=real_steps)
    assert report["stop_error"] == pytest.approx((2 + 0 + 4) / 3)
    nothing = honesty(~REAL, REAL, imagined_steps=imagined_steps, real_steps=real_steps)
    assert math.isnan(nothing["stop_error"])


def test_outcomes_of_different_length_are_refused():
    with pytest.raises(ValueError, match="same episodes"):
        honesty(IMAGINED, REAL[:3])
