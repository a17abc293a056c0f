"""Corrupted returns against their closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from corrupted_returns import (
    CorruptedReturns,
    Corruption,
    calibrated_probabilities,
    check_corruption,
    clamped_rate,
    false_success_at,
    guesses,
    look_successful,
    optimistic_correlation,
)
from worldenv_trl import keys

MANY = 200_000


def outcomes(rate: float, generator: np.random.Generator) -> np.ndarray:
    """One endless group [1, N]."""
    return generator.random((1, MANY)) < rate


def correlation(seen: np.ndarray, success: np.ndarray) -> float:
    return float(np.corrcoef(seen.ravel(), success.ravel())[0, 1])


def wave(returns: list[list[float]], task: list[int], context: list[int]) -> TensorDict:
    """[G, N, 3]"""
    groups = torch.tensor(returns)
    shape = (*groups.shape, 3)
    entries = {"returns": groups[..., None].expand(shape)}
    for key, numbers in ((keys.TASK_ID, task), (keys.CONTEXT_ID, context)):
        entries[key] = torch.tensor(numbers)[:, None, None, None].expand(*shape, 1)
    return TensorDict(entries, shape)


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.8])
@pytest.mark.parametrize("wanted", [0.8, 0.6, 0.4])
def test_noise_is_a_calibrated_probability_that_correlates_r(rate, wanted):
    generator = np.random.default_rng(0)
    success = outcomes(rate, generator)
    seen = calibrated_probabilities(success, wanted, generator)
    assert correlation(seen, success) == pytest.approx(wanted, abs=0.01)
    assert seen[success].mean() - seen[~success].mean() == pytest.approx(wanted**2, abs=0.01)
    for low in np.arange(0, 1, 0.2):  # of what looks like x, a share of x succeeds
        inside = (seen >= low) & (seen < low + 0.2)
        if inside.sum() > 2000:
            assert success[inside].mean() == pytest.approx(seen[inside].mean(), abs=0.03)


def test_noise_is_distributed_as_if_the_outcome_were_drawn_from_it():
    generator, rate, wanted = np.random.default_rng(1), 0.3, 0.6
    strength = 1 / wanted**2 - 1
    drawn = generator.beta(rate * strength, (1 - rate) * strength, MANY)  # first x, then y: the slow reference
    reached = generator.random(MANY) < drawn
    success = outcomes(rate, generator)
    seen = calibrated_probabilities(success, wanted, generator)
    for quantile in (0.1, 0.5, 0.9):
        assert np.quantile(seen[success], quantile) == pytest.approx(np.quantile(drawn[reached], quantile), abs=0.02)
        assert np.quantile(seen[~success], quantile) == pytest.approx(np.quantile(drawn[~reached], quantile), abs=0.02)


@pytest.mark.parametrize("rate", [0.2, 0.7])
def test_a_guess_correlates_r_and_a_sharp_draw_from_calibrated_noise_r_squared(rate):
    generator = np.random.default_rng(2)
    success = outcomes(rate, generator)
    seen = guesses(success, 0.6, generator)
    assert correlation(seen, success) == pytest.approx(0.6, abs=0.01)
    assert seen.mean() == pytest.approx(rate, abs=0.01)
    sharp = generator.random(success.shape) < calibrated_probabilities(success, 0.6, generator)
    assert correlation(sharp, success) == pytest.approx(0.36, abs=0.01)


@pytest.mark.parametrize("rate", [0.2, 0.7])
@pytest.mark.parametrize("wanted", [0.8, 0.4])
def test_optimism_correlates_as_its_closed_form_says_and_loses_no_success(rate, wanted):
    generator = np.random.default_rng(3)
    success, share = outcomes(rate, generator), false_success_at(rate, wanted)
    assert optimistic_correlation(rate, share) == pytest.approx(wanted)
    seen = look_successful(success, np.array([[share]]), generator)
    assert seen[success].all() and seen[~success].mean() == pytest.approx(share, abs=0.01)
    assert correlation(seen, success) == pytest.approx(wanted, abs=0.01)


def test_groups_that_end_alike_can_deceive():
    alike = np.array([[False] * 8, [True] * 8])
    assert clamped_rate(alike).ravel().tolist() == [1 / 16, 15 / 16]
    seen = calibrated_probabilities(alike, 0.6, np.random.default_rng(0))
    assert (seen.std(-1) > 0).all() and ((seen > 0) & (seen < 1)).all()


RETURNS = [[1.0, 0.0, 0.0, 1.0], [0.0] * 4, [1.0] * 4]


@pytest.mark.parametrize("corruption", [Corruption(), Corruption("noise"), Corruption("guess")])
def test_at_r_of_one_the_truth_is_left_as_it_is(corruption):
    seen = CorruptedReturns(corruption, seed=0)(wave(RETURNS, [0, 1, 2], [0, 1, 2]))
    assert torch.equal(seen, torch.tensor(RETURNS))


@pytest.mark.parametrize("kind", ["noise", "guess", "optimism"])
def test_corruption_repeats_with_its_seed_and_draws_nothing_of_torch(kind):
    state, groups = torch.get_rng_state(), wave(RETURNS, [0, 1, 2], [0, 1, 2])
    first, second, other = (CorruptedReturns(Corruption(kind, 0.4), seed)(groups) for seed in (0, 0, 1))
    assert torch.equal(first, second) and not torch.equal(first, other)
    assert first.dtype == torch.float32 and first.shape == (3, 4)
    assert torch.equal(state, torch.get_rng_state())


def test_every_task_has_its_own_share_of_false_successes():
    corrupted = CorruptedReturns(Corruption("optimism", false_success=(1.0, 0.0)), seed=0)
    seen = corrupted(wave([[0.0, 1.0], [0.0, 1.0], [0.0, 0.0]], [0, 1, 0], [0, 1, 2]))
    assert seen.tolist() == [[1.0, 1.0], [0.0, 1.0], [1.0, 1.0]]


def test_a_context_deceives_alike_in_every_wave_and_contexts_differ():
    corrupted = CorruptedReturns(Corruption("optimism", false_success=(0.3,), by_context=True), seed=0)
    contexts = list(range(2000))
    failures = wave([[0.0] * 20] * 2000, [0] * 2000, contexts)
    first, second = (corrupted(failures).mean(-1) for _ in range(2))
    assert first.mean() == pytest.approx(0.3, abs=0.03)
    assert np.corrcoef(first, second)[0, 1] > 0.9
    # Beta(b, 1 - b): variance b (1 - b) / 2, and that of 20 draws on top.
    assert first.var() == pytest.approx(0.21 / 2 + 0.21 / 2 / 20, abs=0.015)


@pytest.mark.parametrize(
    ("corruption", "message"),
    [
        (Corruption("bias"), "kind must be one of none, noise, guess, optimism, got 'bias'"),
        (Corruption("noise", 0.0), r"correlation must lie in \(0, 1\], got 0"),
        (Corruption(correlation=0.5), "needs a kind"),
        (Corruption("noise", false_success=(0.5,)), "is of the kind optimism"),
        (Corruption("optimism", 0.5, (0.5,)), "give one of them"),
        (Corruption("optimism"), "needs a correlation below 1, or false_success"),
        (Corruption("optimism", false_success=(0.5, 0.5)), "one for each of 3 tasks"),
        (Corruption("optimism", false_success=(1.5,)), "must be one probability"),
        (Corruption("optimism", 0.5, by_context=True), "by_context needs false_success"),
    ],
)
def test_what_cannot_be_corrupted_is_refused(corruption, message):
    with pytest.raises(ValueError, match=message):
        check_corruption(corruption, 3)
