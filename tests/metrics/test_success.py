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
    change = torch.cat([after.double() - before.double(), torch.tensor([1.0, -1.0]) * 0.5**0.5])
    mean = 60 / 602  # two pairs more, a half of each kind: they add nothing to the sum and one to that of squares
    half = 1.96 * math.sqrt(change.square().mean().item() - mean**2) / math.sqrt(602)
    assert (test["low"], test["high"]) == pytest.approx((mean - half, mean + half))


@pytest.mark.parametrize(("n", "least"), [(6, 0.82), (20, 0.87)])
def test_of_few_episodes_the_interval_covers_the_difference_as_often_as_it_says(n, least):
    """By the exact distribution; without the two pairs more it does 81 and 91 times of a hundred, at the least 26."""
    pairs = [(gained, lost) for gained, lost in itertools.product(range(n + 1), repeat=2) if gained + lost <= n]
    tests = [paired_test(*outcomes(gained, lost, n - gained - lost)) for gained, lost in pairs]
    assert all(-1 <= test["low"] < test["high"] <= 1 for test in tests)
    covered = []
    for gain, loss in itertools.product(torch.arange(0, 1, 0.1).tolist(), repeat=2):
        if 0 < gain + loss < 0.99:
            chances = [
                math.comb(n, gained) * math.comb(n - gained, lost) * gain**gained * loss**lost
                * (1 - gain - loss) ** (n - gained - lost)
                for gained, lost in pairs
            ]  # fmt: skip
            inside = [test["low"] <= gain - loss <= test["high"] for test in tests]
            covered.append(sum(chance for chance, yes in zip(chances, inside, strict=True) if yes))
    assert min(covered) > least and sum(covered) / len(covered) > 0.935


def test_thousands_of_discordant_pairs_do_not_overflow():
    assert 0 < paired_test(*outcomes(2100, 1900, 0))["p_value"] < 0.01
    assert paired_test(*outcomes(3000, 0, 0))["p_value"] == pytest.approx(0, abs=1e-300)


def test_episodes_that_do_not_pair_up_are_refused():
    with pytest.raises(ValueError, match="same episodes"):
        paired_test(torch.ones(3, dtype=torch.bool), torch.ones(4, dtype=torch.bool))
    with pytest.raises(ValueError, match="same episodes"):
        paired_test(torch.ones(0, dtype=torch.bool), torch.ones(0, dtype=torch.bool))
