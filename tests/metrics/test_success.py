from __future__ import annotations

import itertools
import math

import pytest
import torch

from worldenv_trl.metrics import paired_test, wilson_interval


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [  # Newcombe, Statistics in Medicine 1998, Table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_the_interval_equals_published_values(successes, n, low, high):
    assert wilson_interval(successes, n) == pytest.approx((low, high), abs=5e-5)


def test_the_interval_solves_the_score_equation():
    for successes, confidence, z in ((3, 0.95, 1.959964), (7, 0.90, 1.644854), (9, 0.99, 2.575829)):
        for bound in wilson_interval(successes, 10, confidence):
            assert abs(successes / 10 - bound) / math.sqrt(bound * (1 - bound) / 10) == pytest.approx(z, abs=1e-5)


def test_certain_outcomes_keep_their_bound():
    assert wilson_interval(0, 50)[0] == 0
    assert wilson_interval(50, 50)[1] == 1
    for n in range(1, 400):  # rounding must not take the rate out of its own interval: 60 of 60 ended below 1
        assert wilson_interval(0, n)[0] == 0 and wilson_interval(n, n)[1] == 1


@pytest.mark.parametrize(("successes", "n", "confidence"), [(1, 0, 0.95), (-1, 5, 0.95), (6, 5, 0.95), (1, 5, 1.0)])
def test_counts_out_of_range_are_refused(successes, n, confidence):
    with pytest.raises(ValueError, match="got"):
        wilson_interval(successes, n, confidence)


def outcomes(gained, lost, same):
    before = torch.tensor([False] * gained + [True] * lost + [True] * same)
    after = torch.tensor([True] * gained + [False] * lost + [True] * same)
    return before, after


@pytest.mark.parametrize(("gained", "lost"), [(0, 0), (1, 0), (6, 1), (2, 5), (4, 4)])
def test_the_exact_p_value_equals_an_enumeration_of_coin_tosses(gained, lost):
    test = paired_test(*outcomes(gained, lost, 3))
    tosses = [sum(coins) for coins in itertools.product((0, 1), repeat=gained + lost)]
    observed = abs(gained - (gained + lost) / 2)
    expected = sum(abs(heads - (gained + lost) / 2) >= observed for heads in tosses) / len(tosses)
    assert test["p_value"] == pytest.approx(expected)
    assert (test["gained"], test["lost"]) == (gained, lost)


def test_score_difference_and_interval():
    before, after = outcomes(120, 60, 420)
    test = paired_test(before, after)
    assert test["z"] == pytest.approx(60 / math.sqrt(180))
    assert test["difference"] == pytest.approx(0.1)
    change = after.double() - before.double()
    half = 1.96 * change.std(correction=0).item() / math.sqrt(600)
    assert (test["low"], test["high"]) == pytest.approx((0.1 - half, 0.1 + half))


def test_thousands_of_discordant_pairs_do_not_overflow():
    assert 0 < paired_test(*outcomes(2100, 1900, 0))["p_value"] < 0.01
    assert paired_test(*outcomes(3000, 0, 0))["p_value"] == pytest.approx(0, abs=1e-300)


def test_episodes_that_do_not_pair_up_are_refused():
    with pytest.raises(ValueError, match="same episodes"):
        paired_test(torch.ones(3, dtype=torch.bool), torch.ones(4, dtype=torch.bool))
    with pytest.raises(ValueError, match="same episodes"):
        paired_test(torch.ones(0, dtype=torch.bool), torch.ones(0, dtype=torch.bool))
