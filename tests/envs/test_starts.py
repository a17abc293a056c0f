"""Where waves begin, in physics and in imagination: orders that stay as they were, gone on with, begun elsewhere."""

from __future__ import annotations

import copy

import pytest
import torch
from imagined_worlds import given, make_env
from torchrl.envs.transforms import StepCounter, TransformedEnv

from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import TabletopEnv
from worldenv_trl.keys import CONTEXT_ID, NOISE_SEED, STATE, TASK_ID

BOWL, STOVE = "starter/put_the_bowl_on_the_plate", "starter/turn_on_the_stove"


def tabletop(groups, rollouts, count=6):
    return TabletopEnv(
        [BOWL, STOVE],
        groups * rollouts,
        cameras=(),
        group_repeats=rollouts,
        init_state_count=count // 2,
        seed=0,
        num_threads=1,
    )


def imagined(groups, rollouts, count=6):
    return make_env(groups, rollouts, count=count)


BOTH = pytest.mark.parametrize("make", [tabletop, imagined])


def wave(env, rollouts):
    """Contexts and tasks [G] of a reset, in which all rows of a group share theirs."""
    td = env.reset()
    ids, tasks = (td[key].reshape(-1, rollouts) for key in (CONTEXT_ID, TASK_ID))
    assert (ids == ids[:, :1]).all()
    return ids[:, 0].tolist(), tasks[:, 0].tolist()


@pytest.mark.parametrize(
    ("groups", "count", "expected"),
    [
        (2, 5, [[104, 101], [100, 103], [102, 103], [104, 100], [101, 102]]),
        (2, 6, [[102, 105], [103, 100], [101, 104], [103, 100], [105, 104], [102, 101]]),
        (7, 3, [[102, 101, 100, 102, 101, 100, 101], [102, 100, 101, 102, 100, 101, 102]]),
    ],
)
def test_the_order_of_imagined_contexts_is_what_it_always_was(groups, count, expected):
    env = make_env(groups, count=count)
    assert [wave(env, 3)[0] for _ in expected] == expected


def test_the_order_of_initial_states_is_what_it_always_was():
    env = tabletop(6, 1, count=10)
    assert [wave(env, 1)[0] for _ in range(4)] == [
        [1, 100004, 2, 100000, 4, 100001],
        [3, 100003, 0, 100002, 2, 100000],
        [0, 100001, 1, 100004, 4, 100003],
        [3, 100002, 4, 100004, 0, 100000],
    ]


@BOTH
def test_a_seeded_env_begins_its_draws_anew(make):
    env = make(2, 1)
    wave(env, 1)
    env.set_seed(5)
    before = [wave(env, 1) for _ in range(5)]
    env.set_seed(5)
    assert [wave(env, 1) for _ in range(5)] == before


def test_contexts_given_by_the_caller_are_not_drawn():
    env, other = imagined(2, 3), imagined(2, 3)
    env.reset(given(env, [[0, 0, 0], [1, 1, 1]]), set_state=True)
    assert [wave(env, 3) for _ in range(3)] == [wave(other, 3) for _ in range(3)]


def test_a_copy_of_an_env_draws_the_same():
    env = imagined(2, 3)
    wave(env, 3)
    other = copy.deepcopy(env)
    assert [wave(env, 3) for _ in range(3)] == [wave(other, 3) for _ in range(3)]


# ----------------------------------------------------------------------------------------------------- going on


@BOTH
def test_a_collector_goes_on_with_the_contexts_and_the_noise_that_come_next(make):
    def collector(seed):
        env = TransformedEnv(make(2, 2), StepCounter(max_steps=2))
        env.set_seed(seed)
        return GroupCollector(env, groups_per_batch=2, total_groups=12, group_size=2)

    def wave(each):
        torch.manual_seed(0)  # of the actions
        return each.next()

    whole, first, second = (collector(seed) for seed in (3, 3, 4))
    expected = [wave(whole) for _ in range(5)]
    for _ in range(3):
        wave(first)
    second.load_state_dict(first.state_dict())
    for later in expected[3:]:
        now = wave(second)
        assert torch.equal(now[CONTEXT_ID], later[CONTEXT_ID])
        assert torch.equal(now["next", STATE], later["next", STATE])
        if make is imagined:
            assert torch.equal(now["next", NOISE_SEED], later["next", NOISE_SEED])
    for each in (whole, first, second):
        each.shutdown()


# ----------------------------------------------------------------------------------------------------- begun elsewhere


@BOTH
def test_an_env_begins_where_another_would_have(make):
    alone, draws, begins = make(4, 2), make(4, 2), make(4, 2)
    for _ in range(3):
        begins.begin_with(draws.draw_starts())
        assert_same_rollout(alone, begins)


@BOTH
def test_some_groups_begin_as_they_would_have_among_all(make):
    alone, draws, part = make(4, 2), make(4, 2), make(2, 2)
    for _ in range(2):
        whole = alone.reset()
        part.begin_with(draws.draw_starts().reshape(4, 2)[2:].reshape(part.batch_size))
        some, expected = part.reset(), whole.reshape(4, 2)[2:]
        for key in (CONTEXT_ID, TASK_ID, STATE):
            assert torch.equal(some[key].reshape(2, 2, -1), expected[key])


def test_the_noise_of_some_imagined_groups_is_theirs_among_all():
    alone, draws, part = (imagined(groups, 2) for groups in (4, 4, 2))
    for _ in range(2):
        torch.manual_seed(0)
        whole = alone.rollout(2)
        part.begin_with(draws.draw_starts()[2:])
        assert torch.equal(part.rollout(2)["next", NOISE_SEED], whole["next", NOISE_SEED][2:])


@BOTH
def test_starts_count_as_a_reset_and_are_used_once(make):
    env, drawn = make(4, 2), make(4, 2)
    starts = drawn.draw_starts()
    first = env.reset()[CONTEXT_ID]
    assert torch.equal(env.reset()[CONTEXT_ID], drawn.reset()[CONTEXT_ID])  # the second of both
    drawn.begin_with(starts)
    assert torch.equal(drawn.reset()[CONTEXT_ID], first)
    assert torch.equal(drawn.reset()["num_steps"], torch.zeros_like(first))


@BOTH
def test_starts_of_another_size_are_refused(make):
    with pytest.raises(ValueError, match="starts must be"):
        make(2, 2).begin_with(make(4, 2).draw_starts())


def assert_same_rollout(one, other):
    rollouts = []
    for env in (one, other):
        torch.manual_seed(0)
        rollouts.append(env.rollout(2))
    first, second = rollouts
    for name in first.keys(True, True):
        value = first.get(name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, second.get(name)), name
