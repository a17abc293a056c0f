from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from worldenv_trl.metrics import advantage_correlation, honesty, rank_correlation

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


def test_the_sign_of_the_stop_error_says_who_is_late():
    steps = torch.tensor([10, 20, 30])
    report = honesty([True] * 3, [True] * 3, imagined_steps=steps + torch.tensor([3, -1, 4]), real_steps=steps)
    assert (report["stop_error"], report["stop_bias"]) == pytest.approx((8 / 3, 2.0))


def test_arrays_do_as_well_as_tensors():
    report = honesty(np.asarray(IMAGINED), np.asarray(REAL))
    assert report == honesty(IMAGINED, REAL)
    assert (report["n"], report["imagined"], report["real"]) == (8, 5 / 8, 4 / 8)


def test_better_policies_should_be_better_in_imagination():
    policy = torch.arange(4).repeat_interleave(4)
    real = torch.arange(16) % 4 < policy  # 0, 1, 2, 3 of 4
    assert honesty(real, real, policy=policy)["rank_correlation"] == pytest.approx(1)
    turned = torch.arange(16) % 4 < 3 - policy
    assert honesty(turned, real, policy=policy)["rank_correlation"] == pytest.approx(-1)


def test_rank_correlation_is_spearmans_with_ties():
    # By hand: ranks 1, 2.5, 2.5, 4 and 2, 1, 3, 4, both with mean 2.5.
    assert rank_correlation([0.1, 0.5, 0.5, 0.9], [2, 1, 3, 4]) == pytest.approx(3.0 / math.sqrt(4.5 * 5))
    assert math.isnan(rank_correlation([1, 1, 1], [1, 2, 3]))
    with pytest.raises(ValueError, match="n >= 2"):
        rank_correlation([1], [1])


def test_videos_add_drift():
    videos = torch.randint(0, 256, (8, 3, 3, 16, 16), dtype=torch.uint8)
    report = honesty(IMAGINED, REAL, imagined_frames=videos, real_frames=videos)
    assert report["drift"]["psnr"].tolist() == [60, 60]


def test_advantages_are_compared_within_groups_only():
    real = torch.tensor([[1, 1, 0, 0], [1, 0, 0, 1], [1, 1, 1, 1], [0, 1, 0, 1]], dtype=torch.bool)
    returns = torch.tensor([[0.9, 0.7, 0.2, 0.3], [0.1, 0.4, 0.3, 0.2], [0.9, 0.1, 0.5, 0.2], [0.5, 0.5, 0.5, 0.5]])
    expected = [np.corrcoef(returns[g], real[g].float())[0, 1] for g in (0, 1)] + [0.0]  # nothing is learned in group 3
    assert advantage_correlation(returns, real) == (pytest.approx(np.mean(expected)), 3)
    # A return that only tells contexts apart says nothing, however well it correlates over all rollouts.
    easy = real.float().mean(1, keepdim=True).expand(4, 4)
    assert np.corrcoef(easy.flatten(), real.flatten().float())[0, 1] > 0.4
    assert advantage_correlation(easy, real) == (0, 3)
    assert math.isnan(advantage_correlation(returns[2:3], real[2:3])[0])
    with pytest.raises(ValueError, match=r"must both be \[G, N\], got \[4, 4\] and \[16\]"):
        advantage_correlation(returns, real.flatten())
