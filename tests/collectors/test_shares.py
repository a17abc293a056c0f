"""How a wave is cut, and where its rollouts begin, here or elsewhere."""

from __future__ import annotations

import pytest
import torch
from shared_waves import (
    DECISIONS,
    GROUPS,
    ROLLOUTS,
    Here,
    assert_equal,
    contexts,
    make_env,
    make_policy,
    spread,
    waves_of,
)
from test_group_collector import WAVES, CountdownEnv
from torchrl.envs.utils import ExplorationType

from worldenv_trl.collectors import SpreadCollector, check_shares
from worldenv_trl.collectors.shares import shares_of
from worldenv_trl.keys import CHUNK, CONTEXT_ID


@pytest.mark.parametrize("deal", [1, 2, 3])
@pytest.mark.parametrize("groups", [1, 2, 7, 24, 32])
@pytest.mark.parametrize("count", [1, 2, 5, 8, 40])
def test_shares_hold_every_group_once_and_begin_with_a_deal(groups, count, deal):
    shares = shares_of(groups, count, deal)
    assert [group for first, size in shares for group in range(first, first + size)] == list(range(groups))
    assert all(first % deal == 0 and size for first, size in shares)
    assert len(shares) == min(count, -(-groups // deal))
    assert max(size for _, size in shares) - min(size for _, size in shares[:-1] or shares) <= deal


def test_groups_are_whole_and_from_the_contexts_that_one_process_draws():
    alone, shared = waves_of(spread(None)), waves_of(spread(Here()))
    assert contexts(shared) == contexts(alone)
    assert all(len(set(group)) == 1 for wave in shared for group in wave[CONTEXT_ID][:, :, 0, 0].tolist())
    assert shared[0].shape == (GROUPS, ROLLOUTS, DECISIONS)


def test_noise_differs_between_shares_waves_and_rollouts():
    noise = torch.stack([wave[CHUNK] for wave in waves_of(spread(Here()))])  # [waves, G, N, T, C, 7]
    assert noise.flatten().unique().numel() > 0.99 * noise.numel()


def test_how_many_workers_there_are_changes_nothing():
    one, three = Here(1), Here(3)
    assert_equal(waves_of(spread(one, shares=3)), waves_of(spread(three, shares=3)))
    assert one.given == three.given == 2 * 3


@pytest.mark.parametrize(
    ("workers", "rollouts", "shares"), [(1, 12, 1), (1, 60, 2), (3, 60, 3), (1, 300, 8), (9, 300, 9)]
)
def test_a_wave_has_a_share_for_every_24_rollouts_and_enough_for_all_workers(workers, rollouts, shares):
    collector = SpreadCollector(
        make_env(rollouts // 2),
        make_policy(),
        create_env_fn=make_env,
        workers=Here(workers),
        groups_per_batch=rollouts // 2,
        group_size=2,
    )
    assert len(collector._bounds) == shares
    collector.shutdown()


@pytest.mark.parametrize("at_once", [2, 3, 5])
def test_waves_collected_at_once_are_those_collected_one_by_one(at_once):
    together, alone = Here(4), Here(1)
    waves = waves_of(spread(together, waves=3, shares=2, waves_at_once=at_once))
    assert_equal(waves, waves_of(spread(alone, waves=3, shares=2)))
    assert together.given == alone.given == 3 * 2  # none too many


def test_waves_at_once_start_no_more_workers_than_they_need_shares():
    for waves, shares in ((4, 1), (2, 2), (1, 3)):  # of 12 rollouts in three deals
        collector = spread(Here(4), waves=waves, waves_at_once=4)
        assert len(collector._bounds) == shares
        collector.shutdown()


def test_other_shares_begin_alike_and_draw_other_noise():
    three, two = waves_of(spread(Here(), shares=3)), waves_of(spread(Here(), shares=2))
    assert contexts(three) == contexts(two)
    assert not torch.equal(three[0][CHUNK], two[0][CHUNK])


def test_without_noise_any_shares_give_what_one_process_gives():
    def quiet():
        policy = make_policy()
        policy.module.forward = lambda state: 0.1 * state.mean(-1)[:, None, None].expand(-1, 8, 7)
        return policy

    greedy = {"exploration_type": ExplorationType.DETERMINISTIC}
    alone = waves_of(spread(None, quiet(), **greedy))
    for shares in (1, 2, 3):
        assert_equal(alone, waves_of(spread(Here(), quiet(), shares=shares, **greedy)))


def test_new_weights_reach_the_next_wave():
    policy = make_policy()
    collector = spread(Here(), policy, waves=2)
    before = collector.next()
    with torch.no_grad():
        policy.module.weight.zero_()
    assert before[CHUNK].abs().min() > 0 and collector.next()[CHUNK].abs().max() == 0


def test_weights_that_stay_are_stored_once():
    stored, workers = [], Here()
    keep, workers.put = workers.put, lambda value: stored.append(value) or keep(value)
    waves_of(spread(workers, waves=3))
    assert len(stored) == 2  # the work and the weights


@pytest.mark.parametrize("taken", [1, 2, 3])
@pytest.mark.parametrize(("before", "after"), [(1, 1), (3, 3), (4, 2), (2, 5)])
def test_a_collector_continues_from_its_state_and_torchs(taken, before, after):
    collector = spread(Here(), waves=5, shares=2, waves_at_once=before)
    for _ in range(taken):
        collector.next()
    state, random = collector.state_dict(), torch.get_rng_state()
    rest = waves_of(collector)
    again = spread(Here(), waves=5, shares=2, waves_at_once=after)
    again.load_state_dict(state)
    torch.set_rng_state(random)
    twice = again.state_dict()
    assert_equal([again.next()], rest[:1])
    again.load_state_dict(twice)
    torch.set_rng_state(random)
    assert_equal(waves_of(again), rest)


def test_one_process_continues_from_the_starts_of_waves_that_were_ready():
    collector = spread(Here(), waves=4, waves_at_once=3)
    collector.next()
    state = collector.state_dict()
    rest = waves_of(collector)
    alone = spread(None, waves=4)
    alone.load_state_dict(state)
    assert contexts(waves_of(alone)) == contexts(rest) and len(rest) == 3


def test_excluded_entries_stay_where_they_are_made():
    wave = waves_of(spread(Here(), waves=1, exclude=["observation", ("next", "observation")]))[0]
    assert "observation" not in wave.keys() and "observation" not in wave["next"].keys()  # noqa: SIM118 - no dict


@pytest.mark.parametrize(
    ("groups", "workers", "deal", "most"), [(3, 4, 1, "at most 3"), (6, 3, 3, "2 with one for each of 3 tasks")]
)
def test_more_workers_than_groups_are_refused_in_one_line(groups, workers, deal, most):
    check_shares(groups, -(-groups // deal), deal)
    with pytest.raises(ValueError, match=f"^{workers} workers .* explore.num_envs={groups}.*{most}") as error:
        check_shares(groups, workers, deal, "explore.num_envs")
    assert "\n" not in str(error.value)


def test_what_cannot_be_shared_out_is_refused():
    for option in ("shares", "waves_at_once"):
        with pytest.raises(ValueError, match=f"{option} must be at least 1, got 0"):
            spread(Here(), **{option: 0})
    with pytest.raises(ValueError, match="CountdownEnv cannot say where its rollouts begin"):
        SpreadCollector(CountdownEnv(WAVES, [2, 3]), None, create_env_fn=make_env, workers=Here(), groups_per_batch=2)
