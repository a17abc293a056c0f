"""ContextSampler against integrals, a Dirichlet process drawn at length, and draws one after the other."""

from __future__ import annotations

import copy
import itertools

import pytest
import torch

from worldenv_trl.envs import ContextSampler

UNSEEN = 99


def observed(returns: dict[int, list[float]], **options) -> ContextSampler:
    sampler = ContextSampler(**options)
    sampler.update(torch.tensor(list(returns)), torch.tensor(list(returns.values())))
    return sampler


FOUR = {1: [1.0, 1.0, 0.0, 0.0], 2: [1.0, 1.0, 1.0, 0.0], 3: [1.0] * 4, 4: [0.0] * 4}


# ----------------------------------------------------------------------------------------------------- the posterior


@pytest.mark.parametrize("prior", [0.25, 0.5, 2.0])
def test_for_success_and_failure_it_is_the_expectation_of_p_times_1_minus_p(prior):
    sampler, ids = observed(FOUR, prior=prior), [*FOUR, UNSEEN]
    logits = torch.linspace(-100, 100, 20_001, dtype=torch.float64)
    p, q = logits.sigmoid(), (-logits).sigmoid()
    for number, got in zip(ids, sampler.expected_variance(ids), strict=True):
        success = sum(FOUR.get(number, []))
        failure = len(FOUR.get(number, [])) - success
        density = p ** (prior + success) * q ** (prior + failure)  # of the logit
        torch.testing.assert_close(got, (density * p * q).sum() / density.sum(), rtol=1e-8, atol=0)


def test_for_other_returns_it_is_that_of_a_dirichlet_process():
    returns, prior = [0.1, 0.6, 0.6, 0.9], 0.25
    atoms = torch.tensor([0.0, 1.0, *returns], dtype=torch.float64)
    torch.manual_seed(0)
    parameters = torch.tensor([prior, prior, 1, 1, 1, 1], dtype=torch.float64)
    weights = torch.distributions.Dirichlet(parameters).sample((100_000,))
    variance = weights @ atoms.square() - (weights @ atoms).square()
    got = observed({7: returns}, prior=prior).expected_variance([7])
    torch.testing.assert_close(got[0], variance.mean(), rtol=0, atol=5 * float(variance.std()) / 100_000**0.5)


def test_rollouts_that_all_return_the_same_teach_little_whatever_it_is():
    low, half, high, mixed = observed({1: [0.0] * 8, 2: [0.5] * 8, 3: [1.0] * 8, 4: [0.0, 1.0] * 4}).expected_variance(
        [1, 2, 3, 4]
    )
    assert float(low) == pytest.approx(float(high)) and max(low, half) < 0.2 * mixed


def test_what_was_observed_is_forgotten_update_by_update():
    sampler = observed({1: [1.0] * 8}, forgetting_factor=0.5, prior=0.25)
    for updates in range(1, 4):
        sampler.update(torch.tensor([2]), torch.tensor([[1.0, 0.0]]))
        success, failure = 0.25 + 8 * 0.5**updates, 0.25
        count = success + failure
        expected = success * failure / (count * (count + 1))
        assert float(sampler.expected_variance([1])) == pytest.approx(expected, rel=1e-12)
    for _ in range(60):
        sampler.update(torch.tensor([2]), torch.tensor([[1.0, 0.0]]))
    assert torch.allclose(*sampler.expected_variance([1, UNSEEN]))


def test_groups_of_one_context_in_one_update_count_together():
    twice, once = ContextSampler(), ContextSampler()
    twice.update(torch.tensor([5, 6, 5]), torch.tensor([[1.0, 0.0], [1.0, 1.0], [0.2, 0.3]]))
    once.update(torch.tensor([5]), torch.tensor([[1.0, 0.0, 0.2, 0.3]]))
    assert torch.equal(twice.expected_variance([5]), once.expected_variance([5])) and len(twice) == 2


# ----------------------------------------------------------------------------------------------------- draws


def test_probabilities_are_scores_to_a_power_and_a_uniform_share():
    sampler, ids = observed(FOUR, temperature=0.5, floor=0.2), [*FOUR, UNSEEN]
    scores = sampler.expected_variance(ids)
    expected = 0.8 * scores**2 / (scores**2).sum() + 0.2 / 5
    torch.testing.assert_close(sampler.probabilities(ids), expected)
    assert torch.equal(observed(FOUR, floor=1.0).probabilities(ids), torch.full((5,), 0.2, dtype=torch.float64))


def test_draws_are_those_of_one_context_after_the_other_without_replacement():
    sampler, ids = observed(FOUR, temperature=1.0), list(FOUR)
    probabilities = sampler.probabilities(ids).tolist()
    expected = {
        (first, second): probabilities[first] * probabilities[second] / (1 - probabilities[first])
        for first, second in itertools.permutations(range(4), 2)
    }
    draws, drawn = 5_000, dict.fromkeys(expected, 0)
    for _ in range(draws):
        drawn[tuple(sampler.draw(ids, 2))] += 1
    for pair, probability in expected.items():
        error = 5 * (probability * (1 - probability) / draws) ** 0.5
        assert drawn[pair] / draws == pytest.approx(probability, abs=error), pair


def test_all_come_before_any_comes_again():
    places = observed(FOUR).draw([*FOUR, UNSEEN], 13)
    assert sorted(places[:5]) == sorted(places[5:10]) == list(range(5)) and len(set(places[10:])) == 3
    assert observed(FOUR).draw(list(FOUR), 0) == []


def test_draws_are_a_function_of_seed_and_updates_and_leave_torch_s_random_numbers_alone():
    def draws(seed, sampler=None):
        sampler = observed(FOUR, seed=seed) if sampler is None else sampler
        sampler.seed(seed)
        return [sampler.draw(list(range(50)), 8) for _ in range(3)]

    state = torch.get_rng_state()
    used = ContextSampler()
    used.update(torch.tensor(list(FOUR)), torch.tensor(list(FOUR.values())))
    used.draw(list(FOUR), 3)
    assert draws(3) == draws(3) == draws(3, used) and draws(3) != draws(4)
    assert torch.equal(torch.get_rng_state(), state)


def _restored(sampler):
    other = ContextSampler(seed=5)
    other.load_state_dict(sampler.state_dict())
    return other


@pytest.mark.parametrize("copied", [copy.deepcopy, _restored])
def test_a_copy_draws_the_same_and_learns_alone(copied):
    sampler = observed(FOUR, seed=1)
    other = copied(sampler)
    assert sampler.draw(list(range(20)), 8) == other.draw(list(range(20)), 8)
    sampler.update(torch.tensor([UNSEEN]), torch.tensor([[1.0, 0.0]]))
    assert len(other) == 4 and len(sampler) == 5


def test_a_state_dict_continues_bit_for_bit():
    sampler, other = observed(FOUR, seed=1), ContextSampler(seed=7)
    sampler.draw(list(FOUR), 3)
    other.load_state_dict(sampler.state_dict())
    for each in (sampler, other):
        each.update(torch.tensor([3, UNSEEN]), torch.tensor([[1.0, 0.0], [0.0, 0.0]]))
    ids = [*FOUR, UNSEEN, 100]
    assert torch.equal(sampler.expected_variance(ids), other.expected_variance(ids))
    assert [sampler.draw(ids, 3) for _ in range(4)] == [other.draw(ids, 3) for _ in range(4)]


# ----------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prior": 0.0}, "prior must be positive, got 0.0"),
        ({"temperature": float("nan")}, "temperature must be positive, got nan"),
        ({"forgetting_factor": 1.1}, r"forgetting_factor must lie in \(0, 1\], got 1.1"),
        ({"floor": -0.1}, "floor must lie between 0 and 1, got -0.1"),
    ],
)
def test_settings_out_of_bounds_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ContextSampler(**options)


@pytest.mark.parametrize(
    ("ids", "returns", "message"),
    [
        ([1, 2], [[1.0, 0.0]], r"got \[2\] and \[1, 2\]"),
        ([1], [1.0], r"got \[1\] and \[1\]"),
        ([-1], [[1.0, 0.0]], "needs contexts with numbers, got context_id -1"),
        ([1], [[1.0, float("nan")]], "returns hold NaN or infinity"),
    ],
)
def test_updates_that_cannot_be_are_refused_and_change_nothing(ids, returns, message):
    sampler = observed(FOUR)
    before = sampler.state_dict()
    with pytest.raises(ValueError, match=message):
        sampler.update(torch.tensor(ids), torch.tensor(returns))
    after = sampler.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


def test_nothing_to_draw_from_is_refused():
    with pytest.raises(ValueError, match="context_ids is empty"):
        ContextSampler().draw([], 1)
    with pytest.raises(ValueError, match="needs contexts with numbers"):
        ContextSampler().draw([3, -1], 1)
