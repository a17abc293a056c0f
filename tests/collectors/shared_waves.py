"""Waves that are shared out: an env that draws nothing, a policy with noise, and workers in this very process."""

from __future__ import annotations

import copy
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase, is_leaf_nontensor
from tensordict.nn import TensorDictModule
from torch import nn

from worldenv_trl.collectors import GroupCollector, SpreadCollector
from worldenv_trl.envs import TabletopEnv, chunked
from worldenv_trl.keys import CHUNK, CONTEXT_ID, STATE

TASKS = ("starter/put_the_bowl_on_the_plate", "starter/open_the_top_drawer")
GROUPS, ROLLOUTS, DECISIONS = 6, 2, 2


def make_env(groups: int, **options: Any):
    """Groups of two, dealt to two tasks, two decisions long."""
    options = {"max_steps": 12, "seed": 3, "cameras": (), "init_state_count": 20, "num_threads": 1} | options
    return chunked(TabletopEnv(list(TASKS), groups * ROLLOUTS, group_repeats=ROLLOUTS, **options))


class Noisy(nn.Module):
    """A chunk that grows with the weight, with noise; where ``marker`` names no file yet, it makes one and dies."""

    def __init__(self, marker: Path | None = None, always: bool = False) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(0.1))
        self.marker, self.always, self.calls, self.process = marker, always, 0, os.getpid()

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        inside = os.getpid() != self.process and self.calls == DECISIONS  # a worker's rollout
        if inside and self.marker is not None and (self.always or not self.marker.exists()):
            self.marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.weight * (state.mean(-1)[:, None, None] + torch.randn(len(state), 8, 7))


def make_policy(**options: Any) -> TensorDictModule:
    return TensorDictModule(Noisy(**options), in_keys=[STATE], out_keys=[CHUNK])


class Here:
    """Workers that are none: the calls are made one after the other in this process."""

    def __init__(self, count: int = 1) -> None:
        self.count, self.given = count, 0

    def put(self, value: Any) -> Any:
        return _Kept(value)

    def map(self, function: Callable, arguments: Sequence[tuple]) -> list:
        self.given += len(arguments)
        state = torch.get_rng_state()
        results = [function(*each) for each in reversed(arguments)][::-1]  # in whatever order
        torch.set_rng_state(state)  # as if it had been drawn elsewhere
        return results

    def shutdown(self) -> None:
        pass


class _Kept:
    count = 0

    def __init__(self, value: Any) -> None:
        self.value = value
        _Kept.count += 1
        self.name = f"kept {_Kept.count}"

    def get(self) -> Any:
        return copy.deepcopy(self.value)


def spread(workers: Any, policy: Any = None, waves: int = 2, shares: int | None = None, **options: Any):
    """A collector of some waves; without workers a GroupCollector."""
    torch.manual_seed(0)
    policy = make_policy() if policy is None else policy
    sizes: dict[str, Any] = {"groups_per_batch": GROUPS, "group_size": ROLLOUTS, "total_groups": waves * GROUPS}
    if workers is None:
        return GroupCollector(make_env(GROUPS), policy, **sizes, **options)
    makes = {"create_env_fn": make_env, "workers": workers, "shares": shares}
    return SpreadCollector(make_env(GROUPS), policy, **makes, **sizes, **options)


def waves_of(collector: GroupCollector) -> list[TensorDictBase]:
    waves = list(collector)
    collector.shutdown()
    return waves


def assert_equal(first: list[TensorDictBase], second: list[TensorDictBase]) -> None:
    """Every entry of every wave, bit for bit."""
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert one.shape == other.shape
        names = set(one.keys(True, True, is_leaf=is_leaf_nontensor))
        assert names == set(other.keys(True, True, is_leaf=is_leaf_nontensor))
        for name in names:
            mine, theirs = one.get(name), other.get(name)
            if isinstance(mine, torch.Tensor):
                assert torch.equal(mine, theirs), name
            else:
                assert mine.tolist() == theirs.tolist(), name


def contexts(waves: list[TensorDictBase]) -> list[list[int]]:
    """Of each group."""
    return [wave[CONTEXT_ID][:, 0, 0, 0].tolist() for wave in waves]
