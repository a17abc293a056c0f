"""The run's recorded rollouts: which are meant by a scale of exploration, and by a share of initial states."""

from __future__ import annotations

import pytest
import torch
from small_run import small_untrained
from tensordict import TensorDict

import config
from demonstrate import demonstrate
from episodes import explored_at, split_by_context
from explore import explore
from physics import exploring_actor, reached_goal
from worldenv_trl import keys
from worldenv_trl.record import read_rollouts


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


def explored_with(folder, **options):
    """A small exploration of two scales, and the demonstrations that are stored with it."""
    sizes = {"episodes_per_task": 4, "num_envs": 2, "scale_factors": (1.0, 0.0)}
    run = small_untrained(folder, max_steps=40, explore=config.Explore(**sizes | options))
    demonstrate(run)
    explore(run)
    return run


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    """An exploration whose second scale is greedy."""
    run = explored_with(tmp_path_factory.mktemp("episodes"))
    yield run
    run.close()


def test_what_was_explored_without_noise_is_the_policys_means(explored):
    greedy = explored_at(explored, 1, [0.0])
    every = read_rollouts(explored.folder.rollouts("explore"))
    policy = explored.policy("sft").eval()
    assert 0 < len(greedy) < len(every)
    own = every[-len(greedy) :]  # of two scales, the second
    assert torch.equal(greedy[keys.CONTEXT_ID], own[keys.CONTEXT_ID][:, 0])
    with torch.no_grad():
        mean = exploring_actor(explored.config, policy, 1.0).get_dist(own[:, 0]).loc[:, 0]
    torch.testing.assert_close(own[keys.ACTION][:, 0], mean.clamp(-1, 1), atol=1e-4, rtol=0)
    noisy = every[: -len(greedy)]
    with torch.no_grad():
        mean = exploring_actor(explored.config, policy, 1.0).get_dist(noisy[:, 0]).loc[:, 0]
    assert (noisy[keys.ACTION][:, 0] - mean).abs().mean() > 0.01
    succeeded = greedy[keys.SUCCESS].flatten(1).any(-1)
    assert torch.equal(succeeded, reached_goal(own))


def test_the_noise_of_chunks_displaces_all_steps_of_an_explored_chunk_alike(explored, tmp_path):
    spreads = []
    for run in (explored_with(tmp_path, noise="chunk", scale_factors=(1.0,)), explored):
        noisy = read_rollouts(run.folder.rollouts("explore"))[:2, : run.config.chunk_length]
        with torch.no_grad():
            dist = exploring_actor(run.config, run.policy("sft").eval(), 1.0).get_dist(noisy[:, 0])
        away = noisy[keys.ACTION] - dist.loc
        inside = (noisy[keys.ACTION].abs() < 1).all(1)  # what leaves the range of actions is clipped
        assert inside.float().mean() > 0.5
        spreads.append((away.amax(1) - away.amin(1))[inside])
    run.close()
    assert spreads[0].max() < 1e-4 and spreads[1].min() > 1e-2
