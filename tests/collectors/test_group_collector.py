"""GroupCollector on an env whose rollouts are known in closed form."""

from __future__ import annotations

import pytest
import torch
from tensordict import NonTensorStack, TensorDict, is_leaf_nontensor
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.data import Binary, Bounded, Composite, NonTensor, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, check_env_specs, exploration_type

from worldenv_trl.collectors import GroupCollector
from worldenv_trl.keys import CONTEXT_ID, INSTRUCTION, MASK
from worldenv_trl.language import instructions_of
from worldenv_trl.objectives import rloo_advantage


class CountdownEnv(EnvBase):
    """Row ``i`` of wave ``w`` ends after ``lengths[w][i]`` steps; its reward is 1 before and ``100 + i`` at the end."""

    batch_locked = True

    def __init__(self, lengths: list[list[int]], batch_size: list[int]) -> None:
        super().__init__(batch_size=batch_size)
        self.lengths, self.wave, self.rows_stepped, self.closings = torch.tensor(lengths), -1, [], 0
        batch = self.batch_size
        self.observation_spec = Composite(
            count=Unbounded((*batch, 1), dtype=torch.float32),
            **{CONTEXT_ID: Unbounded((*batch, 1), dtype=torch.int64), INSTRUCTION: NonTensor(batch, example_data="go")},
            shape=batch,
        )
        self.action_spec = Bounded(-1.0, 1.0, (*batch, 2))
        self.reward_spec = Unbounded((*batch, 1))
        flag = Binary(shape=(*batch, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch)

    def _set_seed(self, seed: int | None) -> None:
        self.seeded = seed
        self.wave = -1

    def close(self, *, raise_if_closed: bool = True) -> None:
        self.closings += 1
        super().close(raise_if_closed=raise_if_closed)

    def _observe(self) -> dict:
        rows = self.batch_size.numel()
        words = [f"task {row}" for row in range(rows)]
        return {
            "count": self.count.clone().view(*self.batch_size, 1),
            CONTEXT_ID: (torch.arange(rows) + 1000 * self.wave).view(*self.batch_size, 1),
            INSTRUCTION: NonTensorStack(*words).reshape(self.batch_size),
        }

    def _reset(self, tensordict: TensorDict | None, **_) -> TensorDict:
        self.wave += 1
        self.count = torch.zeros(self.batch_size.numel())
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            {**self._observe(), "done": done, "terminated": done.clone(), "truncated": done.clone()}, self.batch_size
        )

    def _step(self, tensordict: TensorDict) -> TensorDict:
        active = tensordict.get("_step", None)
        active = torch.ones(len(self.count), dtype=torch.bool) if active is None else active.reshape(-1)
        self.rows_stepped.append(int(active.sum()))
        self.count += active
        done = self.count >= self.lengths[self.wave % len(self.lengths)]
        reward = torch.where(done, 100.0 + torch.arange(len(done)), 1.0)
        done = done.view(*self.batch_size, 1)
        return TensorDict(
            {
                **self._observe(),
                "reward": reward.view(*self.batch_size, 1),
                "done": done,
                "terminated": done.clone(),
                "truncated": torch.zeros_like(done),
            },
            self.batch_size,
        )


WAVES = [[3, 1, 5, 2, 2, 4], [1, 1, 2, 1, 1, 1]]


class Policy(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linear, self.frozen, self.seen = nn.Linear(1, 2), nn.Dropout(0.5).eval(), []

    def forward(self, count: torch.Tensor) -> torch.Tensor:
        self.seen.append((self.training, torch.is_grad_enabled(), exploration_type()))
        return self.linear(count).tanh()


def make_policy() -> TensorDictModule:
    return TensorDictModule(Policy(), in_keys=["count"], out_keys=["action"])


def make_collector(batch_size=(2, 3), policy=None, **kwargs) -> GroupCollector:
    kwargs = {"groups_per_batch": 2, "total_groups": 4} | kwargs
    return GroupCollector(CountdownEnv(WAVES, list(batch_size)), policy or make_policy(), **kwargs)


def test_the_env_of_these_tests_is_sound():
    check_env_specs(CountdownEnv([[3] * 6], [2, 3]))


@pytest.mark.parametrize(("batch_size", "group_size"), [((2, 3), None), ((2, 3), 3), ((6,), 3)])
def test_groups_are_complete_and_marked_up_to_their_own_end(batch_size, group_size):
    batches = list(make_collector(batch_size, group_size=group_size))
    assert len(batches) == 2
    for wave, batch in enumerate(batches):
        lengths = torch.tensor(WAVES[wave]).view(2, 3)
        assert batch.shape == (2, 3, int(lengths.max()))
        assert torch.equal(batch[MASK], torch.arange(batch.shape[-1]) < lengths[..., None])
        assert batch[MASK].dtype == torch.bool
        ends = batch["next", "done"].squeeze(-1) & batch[MASK]
        assert torch.equal(ends.sum(-1), torch.ones(2, 3, dtype=torch.int64))
        starts = batch["count"][..., 0, 0]
        assert not starts.any()  # every row begins at a reset, once
        assert torch.equal(batch[CONTEXT_ID][..., 0, 0], torch.arange(6).view(2, 3) + 1000 * wave)
        for group, row in ((0, 0), (0, 2), (1, 1)):
            assert batch[group, row, 0][INSTRUCTION] == f"task {3 * group + row}"


def test_returns_count_each_reward_once_and_are_ready_for_leave_one_out():
    batch = next(iter(make_collector()))
    expected = torch.tensor([[100 + i + n - 1 for i, n in enumerate(WAVES[0])]], dtype=torch.float32).view(2, 3)
    assert torch.equal(batch["returns"], expected[..., None].expand(2, 3, 5))
    advantage = rloo_advantage(batch["returns"][..., 0])
    assert advantage[0, 0].item() == pytest.approx((expected[0, 0] - (expected[0, 1] + expected[0, 2]) / 2).item())


def test_finished_rows_are_not_stepped():
    collector = make_collector()
    next(iter(collector))
    assert collector.env.rows_stepped == [6, 5, 3, 2, 1]


def test_several_waves_make_a_batch_padded_to_the_longest():
    batch = make_collector(groups_per_batch=4).next()
    lengths = torch.tensor(WAVES).view(4, 3)
    assert batch.shape == (4, 3, 5)
    assert torch.equal(batch[MASK], torch.arange(5) < lengths[..., None])
    final = torch.tensor([[100 + i + n - 1 for i, n in enumerate(wave)] for wave in WAVES], dtype=torch.float32)
    assert torch.equal(batch["returns"][..., -1], final.view(4, 3))
    assert torch.equal(batch["returns"][..., 0], final.view(4, 3))


def test_the_policy_runs_without_gradients_in_eval_mode_and_comes_back_as_it_was():
    policy = make_policy()
    batch = make_collector(policy=policy).next()
    assert set(policy.module.seen) == {(False, False, ExplorationType.RANDOM)}
    assert policy.training and policy.module.linear.training and not policy.module.frozen.training
    assert not batch["action"].requires_grad
    policy.module.seen.clear()
    make_collector(policy=policy, exploration_type=ExplorationType.DETERMINISTIC).next()
    assert {seen[2] for seen in policy.module.seen} == {ExplorationType.DETERMINISTIC}


def test_an_error_in_the_env_leaves_the_policy_in_its_mode():
    collector = make_collector()
    collector.env._step = None
    with pytest.raises(TypeError):
        collector.next()
    assert collector.policy.training and not collector.policy.module.frozen.training


def test_without_a_policy_actions_are_random():
    collector = GroupCollector(CountdownEnv(WAVES, [2, 3]), groups_per_batch=2, total_groups=2)
    assert collector.next()["action"].std() > 0


def test_a_rollout_is_cut_at_the_limit_of_decisions():
    batch = make_collector(max_decisions=2).next()
    assert torch.equal(batch[MASK].sum(-1), torch.tensor(WAVES[0]).clamp(max=2).view(2, 3))


def test_it_is_one_of_torchrls_collectors():
    calls = []
    collector = make_collector()
    assert isinstance(collector, BaseCollector) and len(collector) == 2
    collector.pre_collect_hook = lambda: calls.append("before")
    collector.post_collect_hook = lambda batch: calls.append(batch.shape)
    batches = list(collector)
    assert calls == ["before", (2, 3, 5), "before", (2, 3, 2)]
    assert collector.stats() == {"frames": int(sum(batch[MASK].sum() for batch in batches)), "batches": 2}
    assert list(collector) == [] and collector.next() is None


def test_an_endless_collector_goes_on_and_has_no_length():
    collector = make_collector(total_groups=-1)
    for _, batch in zip(range(5), collector, strict=False):
        assert batch.shape[:2] == (2, 3)
    with pytest.raises(RuntimeError, match="endless"):
        len(collector)


def test_weights_arrive_in_every_form():
    other = make_policy()
    forms = (other, other.state_dict(), TensorDict.from_module(other))
    for kwargs in (*({"policy_or_weights": form} for form in forms), {"weights": forms[2]}, {"policy": other}):
        collector = make_collector()
        kept = list(collector.policy.parameters())
        collector.update_policy_weights_(**kwargs)
        for parameter, same, source in zip(collector.policy.parameters(), kept, other.parameters(), strict=True):
            assert parameter is same and torch.equal(parameter, source) and parameter.data_ptr() != source.data_ptr()
            assert parameter.requires_grad
    collector.update_policy_weights_()
    with pytest.raises(ValueError, match="once"):
        collector.update_policy_weights_(other, policy=other)


def test_a_function_has_no_weights_to_update():
    collector = make_collector(policy=lambda td: td.set("action", torch.zeros(2, 3, 2)))
    with pytest.raises(ValueError, match="no weights"):
        collector.update_policy_weights_(make_policy())


def test_a_saved_collector_resumes_where_it_was():
    first = make_collector(total_groups=6)
    first.next()
    second = make_collector(total_groups=6)
    second.load_state_dict(first.state_dict())
    assert torch.equal(second.policy.module.linear.weight, first.policy.module.linear.weight)
    assert second.stats()["frames"] == first.stats()["frames"]
    assert len(list(second)) == 2


def test_a_state_without_weights_leaves_those_of_the_policy_alone():
    first, second = make_collector(total_groups=6), make_collector(total_groups=6)
    first.next()
    before = second.policy.module.linear.weight.clone()
    state = first.state_dict(weights=False)
    assert "policy_state_dict" not in state
    second.load_state_dict(state)
    assert torch.equal(second.policy.module.linear.weight, before) and len(list(second)) == 2


def test_a_seed_fixes_env_and_samples():
    batches = []
    for _ in range(2):
        collector = GroupCollector(CountdownEnv(WAVES, [2, 3]), groups_per_batch=2, total_groups=2)
        collector.set_seed(3)
        assert collector.env.seeded == 3
        batches.append(collector.next())
    assert torch.equal(batches[0]["action"], batches[1]["action"])


def test_excluded_entries_are_in_no_step_and_nothing_else_changes():
    torch.manual_seed(0)
    policy = make_policy()
    whole, part = (
        make_collector(policy=policy, exclude=exclude).next()
        for exclude in ((), ["count", ("next", "count"), ("next", INSTRUCTION)])
    )
    left_out = {"count", ("next", "count"), ("next", INSTRUCTION)}
    names = set(whole.keys(True, True, is_leaf=is_leaf_nontensor))
    assert set(part.keys(True, True, is_leaf=is_leaf_nontensor)) == names - left_out
    for name in names - left_out - {INSTRUCTION}:
        assert torch.equal(whole[name], part[name]), name
    assert instructions_of(part) == instructions_of(whole)


def test_what_is_excluded_can_change_from_batch_to_batch():
    collector = make_collector()
    collector.exclude = [("next", "count")]
    assert ("next", "count") not in collector.next().keys(True)
    collector.exclude = ()
    assert ("next", "count") in collector.next().keys(True)
    assert "_post_step_mdp_hooks" not in vars(collector.env)


@pytest.mark.parametrize("name", ["next", ("next", "done"), ("next", "reward")])
def test_what_the_collector_reads_cannot_be_excluded(name):
    with pytest.raises(ValueError, match="must leave reward and done flags"):
        make_collector(exclude=[name])
    with pytest.raises(ValueError, match="must be a sequence"):
        make_collector(exclude="count")


def test_shutdown_closes_the_env_once_and_ends_the_collection():
    collector = make_collector()
    collector.shutdown()
    collector.shutdown()
    assert collector.env.closings == 1
    with pytest.raises(RuntimeError, match="shut down"):
        next(iter(collector))
    kept = make_collector()
    kept.shutdown(close_env=False)
    assert kept.env.closings == 0


@pytest.mark.parametrize(
    ("batch_size", "kwargs", "message"),
    [
        ((6,), {"group_size": 4}, "group_size must divide"),
        ((6,), {"group_size": 0}, "group_size must divide"),
        ((2, 3), {"group_size": 2}, "env.batch_size must be"),
        ((1, 2, 3), {}, "env.batch_size must be"),
        ((2, 3), {"groups_per_batch": 3}, "groups_per_batch must be a multiple"),
        ((2, 3), {"total_groups": 3}, "total_groups must be"),
        ((2, 3), {"max_decisions": 0}, "max_decisions must be"),
    ],
)
def test_sizes_that_do_not_divide_are_named(batch_size, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_collector(batch_size, **kwargs)
