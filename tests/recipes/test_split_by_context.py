import pytest
import torch
from tensordict import TensorDict

from episodes import split_by_context
from worldenv_trl import keys


def episodes(numbers):
    return TensorDict({keys.CONTEXT_ID: torch.tensor(numbers).unsqueeze(-1)}, batch_size=[len(numbers)])


def states(part):
    return set(part[keys.CONTEXT_ID].flatten().tolist())


def test_a_split_is_by_initial_state_and_about_the_share():
    numbers = list(range(1000)) * 2
    training, kept_out = split_by_context(episodes(numbers), 0.2, seed=3)
    assert not states(training) & states(kept_out) and len(training) + len(kept_out) == 2000
    assert 160 <= len(states(kept_out)) <= 240  # three standard deviations of a binomial
    assert len(kept_out) == 2 * len(states(kept_out))


@pytest.mark.parametrize("seed", range(5))
def test_what_one_round_trains_on_no_other_round_keeps_out(seed):
    first, second = list(range(0, 60, 2)), list(range(60))
    trained, _ = split_by_context(episodes(first), 0.25, seed)
    _, kept_out = split_by_context(episodes(first + second), 0.25, seed)
    assert states(kept_out) and not states(trained) & states(kept_out)


def test_a_smaller_share_is_part_of_a_larger_and_seeds_differ():
    everything = episodes(list(range(200)))
    small, large = (states(split_by_context(everything, share, 0)[1]) for share in (0.08, 0.2))
    assert small < large and large != states(split_by_context(everything, 0.2, 1)[1])


@pytest.mark.parametrize("share", [0.0, 0.01, 0.99, 1.0])
def test_either_side_has_a_state(share):
    for seed in range(5):
        training, kept_out = split_by_context(episodes([4, 4, 9]), share, seed)
        assert len(states(training)) == len(states(kept_out)) == 1
