"""The groups of a wave as shares, each collected by itself, wherever that is."""

from __future__ import annotations

import functools
import itertools
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from worldenv_trl.collectors.group_collector import GroupCollector
from worldenv_trl.collectors.workers import Stored

__all__ = ["Share", "Work", "check_shares", "collect_share", "shares_of"]

_HELD = 6  # envs of a worker: those of a stage, and of its probes


@dataclass(frozen=True)
class Work:
    """What all shares of a collector have in common."""

    create_env_fn: Callable[[int], EnvBase]
    policy: Any
    group_size: int
    max_decisions: int
    exploration_type: ExplorationType

    def collector(self, groups: int) -> GroupCollector:
        return GroupCollector(
            self.create_env_fn(groups),
            self.policy,
            groups_per_batch=groups,
            group_size=self.group_size,
            max_decisions=self.max_decisions,
            exploration_type=self.exploration_type,
        )


@dataclass(frozen=True)
class Share:
    """Some consecutive groups of a wave.

    Args:
        starts: TensorDict ``[groups, N]`` of the env's ``draw_starts``.
        noise_seed: of everything that the policy draws from torch's generator.
        exclude: entries that no one reads.
    """

    starts: TensorDictBase
    noise_seed: int
    exclude: tuple[NestedKey, ...]


def shares_of(groups: int, count: int, deal: int = 1) -> list[tuple[int, int]]:
    """``count`` shares of ``groups`` as (first group, number of groups), as even as whole deals can be.

    Args:
        groups: of the wave.
        count: of shares; fewer come if there are not so many deals.
        deal: groups that belong together, one for each task; the last deal may be cut short.

    Examples:
        >>> shares_of(32, 4, deal=3)
        [(0, 9), (9, 9), (18, 9), (27, 5)]
        >>> shares_of(2, 4)
        [(0, 1), (1, 1)]
    """
    deals = -(-groups // deal)
    count = min(count, deals)
    bounds = [min(groups, deal * (index * (deals // count) + min(index, deals % count))) for index in range(count + 1)]
    return [(first, last - first) for first, last in itertools.pairwise(bounds)]


def check_shares(groups: int, workers: int, deal: int = 1, name: str = "the wave") -> None:
    """Whether every worker would have something to do with a wave.

    Raises:
        ValueError: if there are more of them than groups (deals of one for each task), naming both.
    """
    deals = -(-groups // deal)
    if workers > deals:
        dealt = "" if deal == 1 else f", {deals} with one for each of {deal} tasks"
        raise ValueError(
            f"{workers} workers are more than the groups of {name}={groups}{dealt}: use at most {deals}, or more groups"
        )


def collect_share(work: Stored, weights: Stored | None, share: Share) -> TensorDictBase:
    """The rollouts ``[groups, N, T]`` of a share, on the CPU: a function of the arguments and of nothing else.

    The env of the work and the values that are stored stay with the process that runs this.
    """
    collector = _held(work, len(share.starts))
    if weights is not None:
        collector.update_policy_weights_(_read(weights))
    collector.env.begin_with(share.starts.reshape(collector.env.batch_size))
    collector.exclude = share.exclude
    torch.manual_seed(share.noise_seed)
    return collector.next().cpu()


def weights_of(policy: Any) -> TensorDict | None:
    """A copy of a policy's parameters and buffers on the CPU."""
    return TensorDict.from_module(policy).data.cpu().clone() if isinstance(policy, nn.Module) else None


_collectors: OrderedDict[tuple[str, int], GroupCollector] = OrderedDict()


def _held(work: Stored, groups: int) -> GroupCollector:
    name = (work.name, groups)
    if name not in _collectors:
        while len(_collectors) >= _HELD:
            _collectors.popitem(last=False)[1].shutdown()
        _collectors[name] = _read(work).collector(groups)
    _collectors.move_to_end(name)
    return _collectors[name]


class _Named:
    """A stored value by its name."""

    def __init__(self, stored: Stored) -> None:
        self.stored = stored

    def __hash__(self) -> int:
        return hash(self.stored.name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Named) and self.stored.name == other.stored.name


@functools.lru_cache(maxsize=4)
def _get(named: _Named) -> Any:
    return named.stored.get()


def _read(stored: Stored) -> Any:
    return _get(_Named(stored))
