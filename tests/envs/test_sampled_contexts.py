"""Contexts that a sampler draws, in physics and in imagination, and the orders that stay as they were without one."""

from __future__ import annotations

import copy

import pytest
import torch
from imagined_worlds import FK, CountingWorldModel, given, make_contexts, make_env
from tensordict import TensorDict
from torchrl.envs.transforms import StepCounter, TransformedEnv

from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import ContextSampler, ImaginedEnv, InitStates, TabletopEnv
from worldenv_trl.keys import CONTEXT_ID, NOISE_SEED, STATE, TASK_ID
from worldenv_trl.scenes import load_task

DRAWER, BOWL, STOVE = (
    f"starter/{name}" for name in ("open_the_top_drawer", "put_the_bowl_on_the_plate", "turn_on_the_stove")
)


def tabletop(groups, rollouts, sampler, count=6, tasks=(BOWL, STOVE)):
    return TabletopEnv(
        list(tasks),
        groups * rollouts,
        cameras=(),
        group_repeats=rollouts,
        init_state_count=count // len(tasks),
        seed=0,
        num_threads=1,
        context_sampler=sampler,
    )


def imagined(groups, rollouts, sampler, count=6):
    return make_env(groups, rollouts, count=count, context_sampler=sampler)


BOTH = pytest.mark.parametrize("make", [tabletop, imagined])


def wave(env, rollouts):
    """Contexts and tasks [G] of a reset, in which all rows of a group share theirs."""
    td = env.reset()
    ids, tasks = (td[key].reshape(-1, rollouts) for key in (CONTEXT_ID, TASK_ID))
    assert (ids == ids[:, :1]).all()
    return ids[:, 0].tolist(), tasks[:, 0].tolist()


# ----------------------------------------------------------------------------------------------------- without one


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
    env = tabletop(6, 1, None, count=10)
    assert [wave(env, 1)[0] for _ in range(4)] == [
        [1, 100004, 2, 100000, 4, 100001],
        [3, 100003, 0, 100002, 2, 100000],
        [0, 100001, 1, 100004, 4, 100003],
        [3, 100002, 4, 100004, 0, 100000],
    ]


# ----------------------------------------------------------------------------------------------------- with one


@BOTH
def test_groups_that_were_mixed_come_again_more_often_and_tasks_stay_balanced(make):
    sampler = ContextSampler(forgetting_factor=1.0)
    env = make(2, 2, sampler)
    ids = sorted({number for _ in range(20) for number in wave(env, 2)[0]})
    assert len(ids) == 6
    mixed = [ids[0], ids[-1]]  # one of each task
    returns = torch.tensor([[1.0, 0.0] * 4 if number in mixed else [1.0] * 8 for number in ids])
    sampler.update(torch.tensor(ids), returns)
    waves = [wave(env, 2) for _ in range(300)]
    assert all(sorted(tasks) == [0, 1] for _, tasks in waves)
    drawn = [number for numbers, _ in waves for number in numbers]
    weights = sampler.expected_variance([mixed[0], ids[1], ids[1]]) ** 2
    expected = float(0.9 * weights[0] / weights.sum() + 0.1 / 3)
    for number in mixed:
        assert drawn.count(number) / 300 == pytest.approx(expected, abs=5 * (expected * (1 - expected) / 300) ** 0.5)
    assert set(drawn) == set(ids)


@BOTH
def test_no_context_comes_twice_in_a_wave_while_there_are_others(make):
    sampler = ContextSampler(floor=0.0)
    env = make(6, 1, sampler)
    numbers, _ = wave(env, 1)
    sampler.update(torch.tensor(numbers[:1]), torch.tensor([[1.0, 0.0] * 8]))
    for _ in range(10):
        assert len(set(wave(env, 1)[0])) == 6


@BOTH
def test_the_seed_and_the_updates_decide(make):
    def waves(seed):
        sampler = ContextSampler()
        env = make(2, 2, sampler)
        env.set_seed(seed)
        out = []
        for number in range(6):
            out.append(wave(env, 2)[0])
            sampler.update(torch.tensor(out[-1]), torch.tensor([[1.0, 0.0], [1.0, float(number % 2)]]))
        return out

    assert waves(3) == waves(3) != waves(4)


@BOTH
def test_a_seeded_env_begins_its_draws_anew_and_forgets_no_returns(make):
    sampler = ContextSampler()
    env = make(2, 1, sampler)
    sampler.update(torch.tensor(wave(env, 1)[0]), torch.tensor([[1.0, 0.0], [1.0, 1.0]]))
    env.set_seed(5)
    before = [wave(env, 1)[0] for _ in range(5)]
    env.set_seed(5)
    assert [wave(env, 1)[0] for _ in range(5)] == before and len(sampler) == 2


def test_groups_that_do_not_divide_among_the_tasks_are_dealt_on_in_the_next_wave():
    env = imagined(3, 1, ContextSampler())
    tasks = [task for _ in range(4) for task in wave(env, 1)[1]]
    assert tasks == [0, 1] * 6


def test_a_row_of_the_tabletop_reset_alone_leaves_groups_whole():
    env = tabletop(2, 2, ContextSampler(), tasks=(DRAWER,))
    before = env.reset()[CONTEXT_ID].flatten().tolist()
    env.reset(TensorDict({"_reset": torch.tensor([True, False, False, False])[:, None]}, [4]))
    assert env.progress()[CONTEXT_ID].flatten().tolist()[1:] == before[1:]
    numbers, _ = wave(env, 2)
    assert numbers[0] != numbers[1]


def test_an_episode_keeps_the_state_that_it_was_given_first():
    starts = InitStates(load_task(DRAWER), sampler=ContextSampler())
    numbers, states = starts.draw_together([4, 4, 5, 9])
    assert numbers[0] == numbers[1] and len(set(numbers)) == 3
    for episode, number, state in zip((4, 5, 9), numbers[1:], states[1:], strict=True):
        again, shown = starts.draw(episode)
        assert again == number and (shown == state).all() and (starts.find(number) == state).all()


def test_contexts_given_by_the_caller_are_not_drawn():
    sampler = ContextSampler()
    env, other = imagined(2, 3, sampler), imagined(2, 3, ContextSampler())
    env.reset(given(env, [[0, 0, 0], [1, 1, 1]]), set_state=True)
    assert [wave(env, 3) for _ in range(3)] == [wave(other, 3) for _ in range(3)]


def test_a_copy_of_an_env_draws_the_same_from_a_sampler_of_its_own():
    env = imagined(2, 3, ContextSampler())
    wave(env, 3)
    other = copy.deepcopy(env)
    assert [wave(env, 3) for _ in range(3)] == [wave(other, 3) for _ in range(3)]
    env.context_sampler.update(torch.tensor([100]), torch.tensor([[1.0, 0.0]]))
    assert len(other.context_sampler) == 0 and other.context_sampler is other._order.sampler


# ----------------------------------------------------------------------------------------------------- refusals


def test_contexts_without_numbers_are_refused_when_the_env_is_built():
    contexts = make_contexts()
    contexts[CONTEXT_ID][2] = -1
    with pytest.raises(ValueError, match="needs contexts with numbers, got context_id -1"):
        ImaginedEnv(CountingWorldModel(), FK, contexts, [2, 3], max_steps=4, context_sampler=ContextSampler())
    states = load_task(DRAWER).init_states("train", 2)
    with pytest.raises(ValueError, match="needs contexts with numbers, got context_id -1"):
        TabletopEnv(DRAWER, 2, cameras=(), init_states=states, context_sampler=ContextSampler())


@pytest.mark.parametrize("mode", ["cycle", "fixed"])
def test_an_order_that_is_fixed_and_a_sampler_are_refused(mode):
    with pytest.raises(ValueError, match=f"init_state_mode must be 'random', got '{mode}'"):
        TabletopEnv(DRAWER, 2, cameras=(), init_state_mode=mode, context_sampler=ContextSampler())


# ----------------------------------------------------------------------------------------------------- going on


@BOTH
@pytest.mark.parametrize("mixed", [False, True])
def test_a_collector_goes_on_with_the_contexts_and_the_noise_that_come_next(make, mixed):
    def collector(seed):
        sampler = ContextSampler() if mixed else None
        env = TransformedEnv(make(2, 2, sampler), StepCounter(max_steps=2))
        env.set_seed(seed)
        return GroupCollector(env, groups_per_batch=2, total_groups=12, group_size=2), sampler

    def wave(each, sampler):
        torch.manual_seed(0)  # of the actions
        out = each.next()
        if mixed:
            sampler.update(out[CONTEXT_ID][:, 0, 0, 0], torch.tensor([[0.0, 1.0], [1.0, 1.0]]))
        return out

    (whole, whole_sampler), (first, first_sampler), (second, second_sampler) = (collector(seed) for seed in (3, 3, 4))
    expected = [wave(whole, whole_sampler) for _ in range(5)]
    for _ in range(3):
        wave(first, first_sampler)
    second.load_state_dict(first.state_dict())
    for later in expected[3:]:
        now = wave(second, second_sampler)
        assert torch.equal(now[CONTEXT_ID], later[CONTEXT_ID])
        assert torch.equal(now["next", STATE], later["next", STATE])
        if make is imagined:
            assert torch.equal(now["next", NOISE_SEED], later["next", NOISE_SEED])
    for each in (whole, first, second):
        each.shutdown()


# ----------------------------------------------------------------------------------------------------- begun elsewhere


@BOTH
@pytest.mark.parametrize("sampled", [False, True])
def test_an_env_begins_where_another_would_have(make, sampled):
    sampler = (lambda: ContextSampler(seed=0)) if sampled else (lambda: None)
    alone, draws, begins = make(4, 2, sampler()), make(4, 2, sampler()), make(4, 2, None)
    for _ in range(3):
        begins.begin_with(draws.draw_starts())
        assert_same_rollout(alone, begins)


@BOTH
def test_some_groups_begin_as_they_would_have_among_all(make):
    alone, draws, part = make(4, 2, None), make(4, 2, None), make(2, 2, None)
    for _ in range(2):
        whole = alone.reset()
        part.begin_with(draws.draw_starts().reshape(4, 2)[2:].reshape(part.batch_size))
        some, expected = part.reset(), whole.reshape(4, 2)[2:]
        for key in (CONTEXT_ID, TASK_ID, STATE):
            assert torch.equal(some[key].reshape(2, 2, -1), expected[key])


def test_the_noise_of_some_imagined_groups_is_theirs_among_all():
    alone, draws, part = (imagined(groups, 2, None) for groups in (4, 4, 2))
    for _ in range(2):
        torch.manual_seed(0)
        whole = alone.rollout(2)
        part.begin_with(draws.draw_starts()[2:])
        assert torch.equal(part.rollout(2)["next", NOISE_SEED], whole["next", NOISE_SEED][2:])


@BOTH
def test_starts_count_as_a_reset_and_are_used_once(make):
    env, drawn = make(4, 2, None), make(4, 2, None)
    starts = drawn.draw_starts()
    first = env.reset()[CONTEXT_ID]
    assert torch.equal(env.reset()[CONTEXT_ID], drawn.reset()[CONTEXT_ID])  # the second of both
    drawn.begin_with(starts)
    assert torch.equal(drawn.reset()[CONTEXT_ID], first)
    assert torch.equal(drawn.reset()["num_steps"], torch.zeros_like(first))


@BOTH
def test_starts_of_another_size_are_refused(make):
    with pytest.raises(ValueError, match="starts must be"):
        make(2, 2, None).begin_with(make(4, 2, None).draw_starts())


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
