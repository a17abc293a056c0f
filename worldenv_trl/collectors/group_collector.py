"""Complete groups of rollouts behind TorchRL's collector interface."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl import keys
from worldenv_trl.devices import device_of
from worldenv_trl.policies import DeviceBridge, Policy, check_pairing

__all__ = ["GroupCollector"]

_READ = (("next", "reward"), ("next", "done"))  # by the collector itself
_TRAJ_IDS = ("collector", "traj_ids")
# What TorchRL's engines hand to every collector: what would cut or mix groups, and what has no meaning for them.
_REFUSED = (
    "compact_obs",
    "compile_policy",
    "cudagraph_policy",
    "init_random_frames",
    "interruptor",
    "max_frames_per_traj",
    "postproc",
    "replay_buffer",
    "split_trajs",
    "track_policy_version",
    "trajs_per_batch",
)
_IGNORED = (
    "auto_register_policy_transforms",
    "extend_buffer",
    "frames_per_batch",
    "no_cuda_sync",
    "reset_at_each_iter",
    "reset_when_done",
    "return_same_td",
    "set_truncated",
    "total_frames",
    "traj_pool",
    "trajs_per_write",
    "trust_policy",
    "use_buffers",
)


class GroupCollector(BaseCollector):
    """Waves of rollouts in which every row runs to its own end: groups are complete, none is cut or started twice.

    Stock collectors reset rows as they finish, which leaves the groups of a leave-one-out baseline unfinished and
    biased. Here a wave resets all rows, rolls until every row is done, and marks what each rollout executed.

    Where TorchRL's collectors count frames, this one counts groups; the rest of the interface is theirs. So their
    process and Ray engines replicate it, whole groups to each worker (see the package's README); a
    :class:`~worldenv_trl.collectors.SpreadCollector` shares out the groups of one wave.

    Args:
        create_env_fn: an env, or what makes one: batch ``[G, N]``, or a flat ``[G * N]`` with ``group_size=N``
            (consecutive rows are a group).
        policy: the behaviour policy; it must not change while a batch is collected. Every
            :class:`~worldenv_trl.policies.Policy` in it is checked against the env.

    Keyword Args:
        groups_per_batch: groups in each yielded batch, a multiple of ``G``.
        total_groups: stop after so many; -1 never stops.
        group_size: see ``create_env_fn``.
        max_decisions: longest rollout in env steps (decisions, for a chunked env); default 10,000.
        exploration_type: of the policy; ``DETERMINISTIC`` is greedy.
        exclude: entries that no one reads, left out of every step as soon as it is over; none by default. See
            :attr:`exclude`.
        policy_factory: makes the policy, instead of ``policy``.
        policy_device: where the policy acts, on a copy if it is elsewhere: :meth:`update_policy_weights_` brings the
            copy up to date. Where the policy is when None.
        env_device: where the env is moved; where it is when None.
        storing_device: where batches are yielded; the env's when None.
        device: of the three above that are None.
        create_env_kwargs: of ``create_env_fn``.
        length: decisions of every batch, which are padded outside the mask and numbered in ``("collector",
            "traj_ids")``: engines stack the batches of their workers. As long as the longest rollout when None.
        worker_idx, pre_collect_hook, post_collect_hook, engine: what TorchRL's engines pass to every collector. Options
            that would cut or mix groups are refused, those without a meaning for groups are ignored.

    Yields:
        TensorDict ``[groups, N, T]`` as ``env.rollout`` writes it, with ``("collector", "mask")`` bool [groups, N, T]:
        False after a rollout's end, and ``returns`` float32 [groups, N, T]: the sum of the rollout's rewards, the same
        at each of its entries.

    Raises:
        ValueError: if sizes do not divide or are below 1, a policy was trained for another env, ``exclude`` names
            reward or done flags, or an engine asks for what would cut groups.
        TypeError: for an unknown option.

    Examples:
        >>> from worldenv_trl.envs import TabletopEnv, chunked
        >>> from worldenv_trl.objectives import rloo_advantage
        >>> options = {"cameras": (), "max_steps": 16, "seed": 0}  # nothing is drawn
        >>> env = chunked(TabletopEnv("starter/open_the_top_drawer", 6, group_repeats=3, **options))
        >>> collector = GroupCollector(env, groups_per_batch=2, total_groups=4, group_size=3)  # random actions
        >>> for batch in collector:
        ...     print(batch.shape, rloo_advantage(batch["returns"][..., 0]).shape)
        torch.Size([2, 3, 2]) torch.Size([2, 3])
        torch.Size([2, 3, 2]) torch.Size([2, 3])
        >>> collector.shutdown()
    """

    _use_buffers = False  # a batch is a new TensorDict: engines must not wait for the first one to change

    def __init__(
        self,
        create_env_fn: EnvBase | Callable[..., EnvBase],
        policy: TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase] | None = None,
        *,
        groups_per_batch: int,
        total_groups: int = -1,
        group_size: int | None = None,
        max_decisions: int | None = None,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
        exclude: Sequence[NestedKey] = (),
        policy_factory: Callable[[], Any] | None = None,
        policy_device: torch.device | str | None = None,
        env_device: torch.device | str | None = None,
        storing_device: torch.device | str | None = None,
        create_env_kwargs: Mapping[str, Any] | None = None,
        device: torch.device | str | None = None,
        length: int | None = None,
        worker_idx: int | None = None,
        pre_collect_hook: Callable[[], None] | None = None,
        post_collect_hook: Callable[[TensorDictBase], None] | None = None,
        **engine: Any,
    ) -> None:
        super().__init__()
        unknown = sorted(engine.keys() - {*_REFUSED, *_IGNORED})
        if unknown:
            raise TypeError(f"GroupCollector has no option {unknown[0]!r}")
        refused = [name for name in _REFUSED if engine.get(name) not in (None, False, 0, -1)]
        if refused:
            raise ValueError(f"groups are collected whole: {refused[0]}={engine[refused[0]]!r} would cut or mix them")
        if policy is not None and policy_factory is not None:
            raise ValueError("give policy or policy_factory, not both")
        env: Any = create_env_fn
        if isinstance(env, list | tuple):  # TorchRL's Ray engine gives every collector a list
            if len(env) != 1:
                raise ValueError(f"a GroupCollector steps one env, got {len(env)}: give it more groups instead")
            env = env[0]
        if not isinstance(env, EnvBase):
            env = env(**dict(create_env_kwargs or {}))
        env_device = device if env_device is None else env_device
        policy_device = device if policy_device is None else policy_device
        storing_device = device if storing_device is None else storing_device
        if env_device is not None and env.device != torch.device(env_device):
            env = env.to(env_device)
        policy = policy if policy_factory is None else policy_factory()
        shape = tuple(env.batch_size)
        if len(shape) == 1:
            size = 1 if group_size is None else group_size
            if size < 1 or shape[0] % size:
                raise ValueError(f"group_size must divide the env's {shape[0]} rows, got {size}")
            shape = (shape[0] // size, size)
        elif len(shape) != 2 or group_size not in (None, shape[1]):
            raise ValueError(f"env.batch_size must be [G, N] or [G * N] with group_size=N, got {list(env.batch_size)}")
        if groups_per_batch < 1 or groups_per_batch % shape[0]:
            raise ValueError(
                f"groups_per_batch must be a multiple of the env's {shape[0]} groups, got {groups_per_batch}"
            )
        if total_groups != -1 and (total_groups < 1 or total_groups % groups_per_batch):
            raise ValueError(f"total_groups must be -1 or a multiple of {groups_per_batch}, got {total_groups}")
        if max_decisions is not None and max_decisions < 1:
            raise ValueError(f"max_decisions must be at least 1, got {max_decisions}")
        for module in policy.modules() if isinstance(policy, nn.Module) else ():
            if isinstance(module, Policy):
                check_pairing(module, env)
        if length is not None and length < 1:
            raise ValueError(f"length must be at least 1, got {length}")
        self.env = env
        self._source = self.policy = policy
        self._acting: Any = policy
        if policy_device is not None and isinstance(policy, nn.Module):
            if device_of(policy) != torch.device(policy_device):
                self.policy = copy.deepcopy(policy).to(policy_device)
            self._acting = DeviceBridge(self.policy)
        self.storing_device = None if storing_device is None else torch.device(storing_device)
        self.length, self.worker_idx = length, worker_idx
        self.pre_collect_hook, self.post_collect_hook = pre_collect_hook, post_collect_hook
        self.exclude = exclude
        self.group_shape = shape
        self.groups_per_batch, self.total_groups = groups_per_batch, total_groups
        self.max_decisions = 10_000 if max_decisions is None else max_decisions
        self.exploration_type = exploration_type
        self._groups = self._frames = 0
        self._iter = -1
        self.closed = False

    @property
    def exclude(self) -> tuple[NestedKey, ...]:
        """Entries of a step that rollouts leave out; assign it to change the batches that follow.

        Images are nearly all of a rollout's memory, twice: an observation of step t is the next one of step t - 1.
        What LOOP never reads: ``("frames", ("next", "frames"), ("next", "observation"))``.
        """
        return self._exclude

    @exclude.setter
    def exclude(self, names: Sequence[NestedKey]) -> None:
        if isinstance(names, str):
            raise ValueError(f"exclude must be a sequence of entries, got {names!r}: write [{names!r}]")
        exclude = tuple(unravel_key(name) for name in names)
        for name in exclude:
            if name == "next" or name in _READ:
                raise ValueError(f"exclude must leave reward and done flags in, got {name!r}")
        self._exclude = exclude

    def iterator(self) -> Iterator[TensorDictBase]:
        while self.total_groups == -1 or self._groups < self.total_groups:
            yield self._batch()

    def __len__(self) -> int:
        """Batches in all; raises ``RuntimeError`` for an endless collector."""
        if self.total_groups == -1:
            raise RuntimeError("this collector is endless (total_groups=-1): it has no length")
        return self.total_groups // self.groups_per_batch

    def __bool__(self) -> bool:
        return True  # whoever asks whether there is a collector shall not get its length

    def _batch(self) -> TensorDictBase:
        if self.closed:
            raise RuntimeError("this collector was shut down: make a new one")
        if self.pre_collect_hook is not None:
            self.pre_collect_hook()
        waves = [self._wave() for _ in range(self.groups_per_batch // self.group_shape[0])]
        length = max(wave.shape[-1] for wave in waves)
        if self.length is not None and length > self.length:
            raise ValueError(f"length must be at least that of the longest rollout, {length}, got {self.length}")
        batch = joined(waves, length if self.length is None else self.length)
        if self.length is not None:
            first = self._groups * batch.shape[1]
            numbers = torch.arange(first, first + batch.shape[:2].numel(), device=batch.device).view(
                *batch.shape[:2], 1
            )
            batch[_TRAJ_IDS] = numbers.expand(batch.shape).contiguous()
        self._groups += self.groups_per_batch
        self._frames += int(batch[keys.MASK].sum())
        self._iter += 1
        if self.storing_device is not None:
            batch = batch.to(self.storing_device)
        if self.post_collect_hook is not None:
            self.post_collect_hook(batch)
        return batch

    @torch.no_grad()
    def _wave(self) -> TensorDictBase:
        modules = list(self.policy.modules()) if isinstance(self.policy, nn.Module) else []
        training = [module for module in modules if module.training]
        try:
            for module in training:
                module.training = False
            with set_exploration_type(self.exploration_type), _leaving_out(self.env, self.exclude):
                rollout = self.env.rollout(
                    self.max_decisions, self._acting, break_when_any_done=False, break_when_all_done=True
                )
        finally:
            for module in training:
                module.training = True
        rollout = rollout.reshape(*self.group_shape, rollout.shape[-1])
        done = rollout["next", "done"].squeeze(-1)  # [G, N, T]
        # A finished row repeats its last entry, reward included: only what comes up to the first done belongs to it.
        mask = (done.cumsum(-1) - done.long()) == 0
        rollout[keys.MASK] = mask
        rewards = rollout["next", "reward"].squeeze(-1)
        rollout["returns"] = torch.where(mask, rewards, 0.0).sum(-1, keepdim=True).expand_as(rewards).contiguous()
        return rollout

    def update_policy_weights_(
        self, policy_or_weights: Any = None, *, weights: Any = None, policy: nn.Module | None = None, **_: Any
    ) -> None:
        """Loads weights into the behaviour policy: a module, a state dict or a TensorDict of parameters.

        Without an argument they are those of the policy that was given, which is the very one that acts unless
        ``policy_device`` made a copy of it.
        """
        given = [source for source in (policy_or_weights, weights, policy) if source is not None]
        if len(given) > 1:
            raise ValueError("give the weights once: positionally, as weights=..., or as policy=...")
        given = given or [self._source]
        if given[0] is self.policy:
            return
        if not isinstance(self.policy, nn.Module):
            raise ValueError("the policy is a function: it has no weights to update")
        if isinstance(given[0], TensorDictBase):
            TensorDict.from_module(self.policy).data.update_(given[0].data)
        else:
            state = given[0].state_dict() if isinstance(given[0], nn.Module) else given[0]
            self.policy.load_state_dict(state)

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seeds the env and torch (the policy's samples); returns the env's next seed."""
        torch.manual_seed(seed)
        return self.env.set_seed(seed, static_seed=static_seed)

    def state_dict(self, *, weights: bool = True) -> OrderedDict[str, Any]:
        """Progress, the policy's weights (unless it stays as it is) and, of an env that has one, its ``order_state()``:
        from which initial states and with which noise its next wave begins."""
        order = getattr(self.env, "order_state", None)
        progress = {"groups": self._groups, "frames": self._frames, "iter": self._iter}
        state = OrderedDict(progress, order=None if order is None else order())
        if weights:
            state["policy_state_dict"] = self.policy.state_dict() if isinstance(self.policy, nn.Module) else {}
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._groups, self._frames = int(state_dict["groups"]), int(state_dict["frames"])
        self._iter = int(state_dict["iter"])
        if isinstance(self.policy, nn.Module) and "policy_state_dict" in state_dict:
            self.policy.load_state_dict(state_dict["policy_state_dict"])
        if state_dict.get("order") is not None:
            self.env.load_order_state(state_dict["order"])

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Ends the collection and, unless told otherwise, closes the env."""
        if self.closed:
            return
        self.closed = True
        if close_env:  # is_closed is no guide: it is True from the start for envs that do not set it
            self.env.close(raise_if_closed=False)


@contextmanager
def _leaving_out(env: EnvBase, names: tuple[NestedKey, ...]) -> Iterator[None]:
    """While it lasts, rollouts of ``env`` drop these entries of a step once the next one has been prepared."""
    if not names:
        yield
        return
    # The hook by which TorchRL lets transient entries be dropped before steps are stacked.
    before, own = env._post_step_mdp_hooks, "_post_step_mdp_hooks" in vars(env)

    def drop(step: TensorDictBase, following: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        if before is not None:
            step, following = before(step, following)
        return step.exclude(*names), following

    env._post_step_mdp_hooks = drop
    try:
        yield
    finally:
        del env._post_step_mdp_hooks  # the class's shows again
        if own:
            env._post_step_mdp_hooks = before


def joined(waves: Sequence[TensorDictBase], length: int) -> TensorDictBase:
    """Waves ``[G, N, T]`` as one ``[sum of G, N, length]``."""
    waves = [_padded(wave, length) for wave in waves]
    return waves[0] if len(waves) == 1 else TensorDict.cat(waves, 0)


def _padded(wave: TensorDictBase, length: int) -> TensorDictBase:
    """``wave [G, N, T]`` extended to ``length`` by repeating its last entry, outside the mask."""
    missing = length - wave.shape[-1]
    if not missing:
        return wave
    tail = wave[..., -1:].expand(*wave.shape[:-1], missing).clone()
    tail[keys.MASK] = torch.zeros_like(tail[keys.MASK])
    return torch.cat([wave, tail], -1)
