"""Agreement of two verdicts, against a published example and counts made one by one."""

from __future__ import annotations

import math

import pytest
import torch

from worldenv_trl.metrics import cohen_kappa, precision, recall


def counts(predicted, actual):
    pairs = list(zip(predicted.tolist(), actual.tolist(), strict=True))
    return [pairs.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False))]


def slow_kappa(predicted, actual):
    yes, false, missed, no = counts(predicted, actual)
    n = yes + false + missed + no
    chance = (yes + false) / n * (yes + missed) / n + (missed + no) / n * (false + no) / n
    return ((yes + no) / n - chance) / (1 - chance)


def test_kappa_of_fifty_grant_proposals():
    # Two readers, 50 proposals: both yes 20, first alone 5, second alone 10, both no 15; kappa is .4.
    predicted = torch.tensor([True] * 25 + [False] * 25)
    actual = torch.tensor([True] * 20 + [False] * 5 + [True] * 10 + [False] * 15)
    assert cohen_kappa(predicted, actual).item() == pytest.approx(0.4)


def test_a_batch_is_figured_row_by_row():
    generator = torch.Generator().manual_seed(0)
    predicted, actual = (torch.rand(2, 3, 40, generator=generator) < 0.4 for _ in range(2))
    for row in ((0, 0), (0, 2), (1, 1)):
        yes, false, missed, _ = counts(predicted[row], actual[row])
        assert cohen_kappa(predicted, actual)[row].item() == pytest.approx(slow_kappa(predicted[row], actual[row]))
        assert precision(predicted, actual)[row].item() == pytest.approx(yes / (yes + false))
        assert recall(predicted, actual)[row].item() == pytest.approx(yes / (yes + missed))


def test_what_cannot_be_said_is_nan():
    yes, no = torch.ones(4, dtype=torch.bool), torch.zeros(4, dtype=torch.bool)
    assert math.isnan(precision(no, yes)) and math.isnan(recall(yes, no)) and math.isnan(cohen_kappa(yes, yes))
    assert (precision(yes, no).item(), recall(no, yes).item(), cohen_kappa(yes, no).item()) == (0, 0, 0)


def test_verdicts_on_other_rollouts_are_refused():
    with pytest.raises(ValueError, match=r"must both be \[\*B, n\], got \[3\] and \[4\]"):
        cohen_kappa(torch.ones(3), torch.ones(4))
