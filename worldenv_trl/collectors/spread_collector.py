"""Waves of groups, shared out among workers."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from worldenv_trl.collectors.group_collector import GroupCollector, joined
from worldenv_trl.collectors.shares import Share, Work, collect_share, shares_of, weights_of
from worldenv_trl.collectors.workers import Stored, Workers
from worldenv_trl.splitmix import splitmix64

__all__ = ["SpreadCollector"]


_SHARES, _ROWS = 8, 24  # parts of a wave by default: so many at most, with so many rollouts at least


class SpreadCollector(GroupCollector):
    """A :class:`GroupCollector` whose waves are collected by workers, some whole groups each.

    ``env`` is never stepped: it draws where rollouts begin, and is what the policy is checked against. Every wave is
    cut into ``shares`` of whole groups, and each goes to the next free worker with its starts, the policy's weights and
    a seed of its own. So a wave is a function of the env's order, the weights, torch's random state and ``shares``,
    never of how many workers collect them, where they run, or which of them died and was replaced: bit for bit on equal
    processors. Initial states and the world model's noise are those of a :class:`GroupCollector`; the policy's noise is
    drawn share by share, so other ``shares`` give other samples of it, and greedy rollouts that differ by rounding.

    Weights travel with the work rather than through a ``torchrl.weight_update`` scheme: its process group has no place
    for a worker that comes back.

    Args:
        env: as of :class:`GroupCollector`, with the whole wave's batch size; it has ``draw_starts`` and ``begin_with``,
            as :class:`~worldenv_trl.envs.TabletopEnv` and :class:`~worldenv_trl.envs.ImaginedEnv` do.
        policy: as there; it and ``create_env_fn`` are pickled.
        workers: who collects; they stay when the collector is shut down.

    Keyword Args:
        create_env_fn: ``create_env_fn(groups)`` makes the same env for so many groups, with the same settings (seed,
            tasks, initial states or contexts) and on a device that the workers have.
        shares: parts of a wave; by default one for every 24 rollouts, 8 at most, but enough for all workers. Never
            more than it has groups (deals of them to the tasks).
        waves_at_once: collected together, and yielded one after the other. The policy and :attr:`exclude` must not
            change between them. A state that is taken between them continues with those that were not yielded.
        others: of :class:`GroupCollector`.

    Raises:
        ValueError: if ``shares`` or ``waves_at_once`` is below 1, or the env cannot say where its rollouts begin.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase] | None = None,
        *,
        create_env_fn: Callable[[int], EnvBase],
        workers: Workers,
        shares: int | None = None,
        waves_at_once: int = 1,
        groups_per_batch: int,
        total_groups: int = -1,
        group_size: int | None = None,
        max_decisions: int | None = None,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
        exclude: Sequence[NestedKey] = (),
    ) -> None:
        super().__init__(
            env,
            policy,
            groups_per_batch=groups_per_batch,
            total_groups=total_groups,
            group_size=group_size,
            max_decisions=max_decisions,
            exploration_type=exploration_type,
            exclude=exclude,
        )
        deal = _entry(env, "groups_per_deal") or 1
        if _entry(env, "draw_starts") is None:
            raise ValueError(
                f"{type(env).__name__} cannot say where its rollouts begin (draw_starts): collect them here"
            )
        groups, rollouts = self.group_shape
        if total_groups > 0 and waves_at_once > 0:
            waves_at_once = min(waves_at_once, total_groups // groups)
        if shares is None:
            enough = -(-workers.count // waves_at_once) if waves_at_once > 0 else 1
            shares = max(1, min(_SHARES, groups * rollouts // _ROWS), enough)
        for name, count in (("shares", shares), ("waves_at_once", waves_at_once)):
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}")
        self.workers, self.waves_at_once = workers, waves_at_once
        self._bounds = shares_of(self.group_shape[0], shares, deal)
        work = Work(create_env_fn, policy, self.group_shape[1], self.max_decisions, exploration_type)
        self._work: Stored | None = workers.put(work)
        self._weights: tuple[TensorDictBase, Stored] | None = None
        self._ready: deque[TensorDictBase] = deque()
        # Of waves that are ready: the env's order before they were drawn, and what their noise was drawn from.
        self._drawn: deque[tuple[Any, int]] = deque()
        self._noise: deque[int] = deque()  # of waves that were ready in a state that was loaded
        self._begun = 0  # waves, those that are ready included

    def _wave(self) -> TensorDictBase:
        if not self._ready:
            count = self.waves_at_once
            if self.total_groups != -1:
                count = min(count, self.total_groups // self.group_shape[0] - self._begun)
            self._ready.extend(self._waves(count))
            self._begun += count
        self._drawn.popleft()
        return self._ready.popleft()

    def _waves(self, count: int) -> list[TensorDictBase]:
        weights = self._stored_weights()
        shares = [share for _ in range(count) for share in self._shares()]
        parts = self.workers.map(collect_share, [(self._work, weights, share) for share in shares])
        waves = []
        for number in range(count):
            own = parts[number * len(self._bounds) : (number + 1) * len(self._bounds)]
            wave = joined(own, max(part.shape[-1] for part in own))
            waves.append(wave if self.env.device is None else wave.to(self.env.device))
        return waves

    def _shares(self) -> list[Share]:
        """Of the next wave."""
        order = _entry(self.env, "order_state")
        noise = self._noise.popleft() if self._noise else int(torch.randint(2**62, ()))
        self._drawn.append((None if order is None else order(), noise))
        starts = self.env.draw_starts().reshape(self.group_shape)
        seeds = splitmix64(torch.arange(len(self._bounds)) ^ noise) & (2**62 - 1)
        return [
            Share(starts[first : first + count].clone(), seed, self.exclude)
            for (first, count), seed in zip(self._bounds, seeds.tolist(), strict=True)
        ]

    def state_dict(self, *, weights: bool = True) -> OrderedDict[str, Any]:
        """As of a :class:`GroupCollector`; of waves that are ready it holds from what they are collected again."""
        state = super().state_dict(weights=weights)
        if self._drawn:
            state["order"] = self._drawn[0][0]
        state["noise"] = [*(noise for _, noise in self._drawn), *self._noise]
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._ready.clear()
        self._drawn.clear()
        self._noise = deque(state_dict.get("noise", ()))
        self._begun = self._groups // self.group_shape[0]

    def _stored_weights(self) -> Stored | None:
        """The policy's weights as they are now; stored again only where they have changed."""
        weights = weights_of(self.policy)
        if weights is None:
            return None
        if self._weights is None or not bool((self._weights[0] == weights).all()):
            self._weights = weights, self.workers.put(weights)
        return self._weights[1]

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        super().shutdown(timeout, close_env, raise_on_error)
        self._work = self._weights = None


def _entry(env: EnvBase, name: str) -> Any:
    try:
        return getattr(env, name)
    except AttributeError:
        return None
