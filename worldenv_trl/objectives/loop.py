"""LOOP: leave-one-out PPO on action chunks (World-Env section 3.4, Eq. 4-5; RIPT-VLA, arXiv 2505.17016)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives.common import LossModule

from worldenv_trl import keys
from worldenv_trl.objectives.distillation import away_from

__all__ = ["LOOPLoss"]

RATIO_LEVELS = ("step", "chunk", "dim", "token")
_EACH = ("dim", "token")  # of policies that write numbers, and of those that write a token for each number
NORMALIZATIONS = ("global", "episode")


class LOOPLoss(LossModule):
    r"""Clipped surrogate of World-Env Eq. 5,

    .. math:: L = -\frac{1}{\sum_n T_n} \sum_n \sum_{t \le T_n}
        \min(r_t A_n, \mathrm{clip}(r_t, 1-\epsilon, 1+\epsilon) A_n),

    over the executed steps ``t`` of rollouts ``n``; ``r_t`` is the probability ratio of step ``t``'s action. Steps of a
    chunk after a stop (``step_mask`` False), and decisions that belong to no rollout (``("collector", "mask")`` False),
    do not count, in value or gradient.

    Reads decisions ``[*B]``: the actor's inputs, ``("vla_action", "chunk")`` [*B, C, 7],
    ``("vla_action", "log_probs")`` [*B, C], ``advantage`` [*B, 1], ``step_mask`` [*B, C], optionally
    ``("collector", "mask")`` [*B] and ``total_steps`` [*B, 1]: the executed steps of the whole batch
    (``normalize="global"``) or of the decision's own rollout (``"episode"``). With it, the losses of minibatches, or of
    processes, add up exactly to the loss of the whole batch; without it, the steps at hand are counted.

    Of tokens that belong to a whole chunk, [*B, L] like their ``log_probs``, ``("vla_action", "token_is_pad")`` [*B, L]
    is read, too.

    The step mask is an outcome of the decision: it is read below ``"next"`` where it exists there, as in every rollout
    (whose root entry belongs to the decision before), and at the root otherwise.

    With ``reference_coef``, also ``held`` bool [*B, 1], ``("reference", "loc")`` and ``("reference", "scale")``
    [*B, C, 7] are read, and ``loss_reference`` (scalar) is to be added,

    .. math:: L_{ref} = \frac{c}{\sum_n T_n} \sum_{n, t\;held} \frac{1}{7} \sum_d
        \frac{|\mu_{t,d} - \mu^{ref}_{t,d}|}{b^{ref}_{t,d}},

    which keeps the mean of an actor with a location (Laplace) where a reference policy has it. World-Env has no such
    term; GRPO (DeepSeekMath, arXiv 2402.03300, Eq. 3) has one everywhere, a divergence of what is sampled. This one is
    of the mean, which the greedy policy takes and sampled returns hardly show.

    Returns ``loss_objective`` (scalar), and detached ``kl_approx`` (mean of ``(r - 1) - log r`` per step),
    ``clip_fraction``, ``ESS`` (effective sample size as a share of the steps).

    Args:
        actor: writes a distribution over chunks whose log-prob is [*B, C] (``event_dims=1``). One of whole
            chunks (:class:`~worldenv_trl.policies.ChunkLaplace`) gives each executed step the ratio of its chunk.

    Keyword Args:
        clip_epsilon: ``epsilon``, or ``(low, high)``.
        ratio_level: ``step`` (the paper); ``chunk``: one ratio for the executed steps of a chunk, counted once for each
            of them; ``dim``: one for each action dimension, averaged (needs log-probs [*B, C, 7], ``event_dims=0``);
            ``token``: the same for a :class:`~worldenv_trl.policies.TokenActor` or
            :class:`~worldenv_trl.policies.AutoregressiveActor`, whose tokens are the action:
            ``set_keys(action=keys.TOKENS)``. Tokens that belong to a whole chunk, [*B, L] (FAST), know ``chunk``, one
            ratio for all of them, and ``token``, the mean over them; either counts once for each executed step, and a
            stop inside the chunk cuts none of them off.
        normalize: ``global`` (the paper) weighs every step equally, ``episode`` every rollout. The latter reads
            ``total_steps`` and the number of rollouts ``num_rollouts`` [*B, 1], or counts both if decisions are
            ``[*rollouts, T]``, time last.
        reference_coef: ``c`` above, at least 0; at 0 nothing is held.
        functional: False keeps the actor's parameters in the actor (needed for adapters injected by peft, and FSDP).

    Raises:
        ValueError: for a setting out of range, entries whose shapes do not match, or log-probs of single steps where
            the actor's are of whole chunks.

    Examples:
        >>> import torch
        >>> from torchrl.envs.utils import ExplorationType, set_exploration_type
        >>> from worldenv_trl.objectives import rloo_advantage
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor, scale_bounds
        >>> policy = OFTPolicy(OFTConfig(instructions=("open the drawer",)))
        >>> groups = policy.post_training_parameters(rank=4)
        >>> actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))

        What a :class:`~worldenv_trl.collectors.GroupCollector` yields, made up: 2 groups, 3 rollouts, 2 decisions.

        >>> shape = (2, 3, 2)
        >>> observation = {"image": torch.zeros(*shape, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(*shape, 7)}
        >>> batch = TensorDict({"observation": observation, "language_instruction": "open the drawer"}, shape)
        >>> with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        ...     batch = actor(batch)
        >>> batch["next", "step_mask"] = torch.ones(*shape, 8, dtype=torch.bool)
        >>> batch["collector", "mask"] = torch.ones(shape, dtype=torch.bool)
        >>> batch["returns"] = torch.rand(2, 3, 1).expand(shape)

        An update:

        >>> loss = LOOPLoss(actor, clip_epsilon=0.1, functional=False)
        >>> batch["advantage"] = rloo_advantage(batch["returns"][..., 0])[..., None, None].expand(*shape, 1)
        >>> decisions = batch[batch["collector", "mask"]]  # [M]
        >>> decisions["total_steps"] = decisions["next", "step_mask"].sum().expand(len(decisions), 1)
        >>> for minibatch in decisions.split(4):  # the gradients add up to that of loss(decisions)
        ...     loss(minibatch)["loss_objective"].backward()
        >>> all(parameter.grad is not None for group in groups.values() for parameter in group)
        True
    """

    @dataclass
    class _AcceptedKeys:
        advantage: NestedKey = keys.ADVANTAGE
        action: NestedKey = keys.CHUNK
        sample_log_prob: NestedKey = keys.LOG_PROBS
        step_mask: NestedKey = keys.STEP_MASK
        token_is_pad: NestedKey = keys.TOKEN_IS_PAD
        mask: NestedKey = keys.MASK
        total_steps: NestedKey = "total_steps"
        num_rollouts: NestedKey = "num_rollouts"
        held: NestedKey = keys.HELD
        reference_loc: NestedKey = keys.REFERENCE_LOC
        reference_scale: NestedKey = keys.REFERENCE_SCALE

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams | None
    target_actor_network_params: TensorDictParams | None

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        *,
        clip_epsilon: float | tuple[float, float] = 0.1,
        ratio_level: str = "step",
        normalize: str = "global",
        reference_coef: float = 0.0,
        functional: bool = True,
    ) -> None:
        if ratio_level not in RATIO_LEVELS:
            raise ValueError(f"ratio_level must be one of {', '.join(RATIO_LEVELS)}, got {ratio_level!r}")
        if normalize not in NORMALIZATIONS:
            raise ValueError(f"normalize must be one of {', '.join(NORMALIZATIONS)}, got {normalize!r}")
        if not 0 <= reference_coef < math.inf:
            raise ValueError(f"reference_coef must be at least 0 and finite, got {reference_coef}")
        self._functional = functional
        super().__init__()
        if functional:
            self.convert_to_functional(actor, "actor_network", create_target_params=False)
        else:
            self.actor_network, self.actor_network_params = actor, None
        self.ratio_level, self.normalize = ratio_level, normalize
        self.clip_epsilon, self.reference_coef = clip_epsilon, float(reference_coef)

    @property
    def functional(self) -> bool:
        return self._functional

    @property
    def clip_epsilon(self) -> tuple[float, float]:
        """``(low, high)``; assign a number or a pair to schedule it."""
        return self._clip_epsilon

    @clip_epsilon.setter
    def clip_epsilon(self, value: float | tuple[float, float]) -> None:
        if isinstance(value, tuple | list) and len(value) != 2:
            raise ValueError(f"clip_epsilon must be a number or (low, high), got {value}")
        low, high = value if isinstance(value, tuple | list) else (value, value)
        if not (0 < low < 1 and 0 < high < math.inf):
            raise ValueError(f"clip_epsilon must be positive (and below 1 downwards), got {value}")
        self._clip_epsilon = (float(low), float(high))

    def _forward_value_estimator_keys(self, **_: object) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        names = self.tensor_keys
        own = [names.action, names.sample_log_prob, names.advantage, names.step_mask]
        own += [names.token_is_pad] if names.token_is_pad in self.actor_network.out_keys else []
        own += [names.held, names.reference_loc, names.reference_scale] if self.reference_coef else []
        return [*own, *(key for key in self.actor_network.in_keys if key not in own)]

    @property
    def out_keys(self) -> list[str]:
        return [
            "loss_objective",
            *(["loss_reference"] if self.reference_coef else []),
            "kl_approx",
            "clip_fraction",
            "ESS",
        ]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.copy()
        steps = self._executed(tensordict)
        distribution, log_ratio, mask, advantage = self._compared(tensordict, steps)
        # min(r A, clip(r) A) is 0 for A = 0; taken out because a ratio that overflows would make it inf * 0.
        ratio = torch.where(mask & (advantage != 0), log_ratio, 0.0).exp()
        low, high = self.clip_epsilon
        gain = torch.minimum(ratio * advantage, ratio.clamp(1 - low, 1 + high) * advantage)  # World-Env Eq. 5
        gain = torch.where(mask, gain, 0.0)
        if self.ratio_level in _EACH:
            if gain.ndim == steps.ndim:  # tokens of whole chunks
                gain = gain.sum(-1, keepdim=True) / mask.sum(-1, keepdim=True).clamp_min(1) * steps
            else:
                gain = gain.mean(-1)
        weight = self._weight(tensordict, steps, gain.dtype)
        out = {"loss_objective": -(gain * weight).sum()}
        if self.reference_coef:
            out["loss_reference"] = self.reference_coef * (self._away(tensordict, distribution, steps) * weight).sum()
        return TensorDict(out | self._diagnostics(log_ratio.detach(), mask))

    @torch.no_grad()
    def ratios(self, tensordict: TensorDictBase) -> TensorDict:
        """Where the actor stands now against the one that acted: reads what :meth:`forward` reads, for a log.

        Returns:
            ``ratio`` [*B, C], new over behaviour probability, and ``clipped`` bool [*B, C], whether the clip takes the
            gradient of that step away (a ratio that has left the interval in the direction of its advantage); 1 and
            False where nothing was executed. Both [*B, C, 7] for ``dim`` and ``token``, and like the tokens of whole
            chunks, [*B, L], for ``token``.
        """
        tensordict = tensordict.copy()  # the actor writes into it
        _, log_ratio, mask, advantage = self._compared(tensordict, self._executed(tensordict))
        ratio = torch.where(mask, log_ratio, 0.0).exp()
        low, high = self.clip_epsilon
        clipped = ((ratio > 1 + high) & (advantage > 0)) | ((ratio < 1 - low) & (advantage < 0))
        return TensorDict({keys.RATIO: ratio, keys.CLIPPED: clipped & mask}, tensordict.batch_size)

    def _away(self, tensordict: TensorDictBase, distribution: Distribution, steps: Tensor) -> Tensor:
        """[*B, C], how far the mean is from the reference's at executed steps of held decisions, in its scale."""
        names = self.tensor_keys
        held = tensordict.get(names.held, None)
        loc, scale = (tensordict.get(name, None) for name in (names.reference_loc, names.reference_scale))
        if held is None or loc is None or scale is None:
            raise ValueError(
                f"reference_coef needs {names.held!r} {[*steps.shape[:-1], 1]}, {names.reference_loc!r} and "
                f"{names.reference_scale!r}, the reference's at each decision: write them, or pass reference_coef=0"
            )
        mean = getattr(distribution, "loc", None)
        if mean is None:
            raise ValueError(f"reference_coef needs an actor with a location, got {type(distribution).__name__}")
        return torch.where(steps & held, away_from(mean, loc, scale), 0.0)

    def _compared(self, tensordict: TensorDictBase, steps: Tensor) -> tuple[Distribution, Tensor, Tensor, Tensor]:
        """What the actor says now, log-ratios of the executed steps [*B, C], where they hold, and the advantage; see
        :meth:`_log_ratio`."""
        names = self.tensor_keys
        chunk, before = tensordict.get(names.action), tensordict.get(names.sample_log_prob)
        if before.requires_grad:
            raise ValueError(f"{names.sample_log_prob} requires grad: collect rollouts under torch.no_grad()")
        padding = tensordict.get(names.token_is_pad, None)
        whole = padding is not None and chunk.ndim == steps.ndim  # tokens that belong to the whole chunk
        if steps.shape[:-1] != chunk.shape[:-1] if whole else steps.shape != chunk.shape[:-1]:
            wanted = [*chunk.shape[:-1], "C"] if whole else list(chunk.shape[:-1])
            raise ValueError(f"{names.step_mask} must be {wanted}, got {list(steps.shape)}")
        advantage = tensordict.get(names.advantage, None)
        if advantage is None:
            raise ValueError(
                f"the tensordict holds no {names.advantage!r} {[*steps.shape[:-1], 1]}: expand rloo_advantage over "
                "the decisions of each rollout"
            )
        if advantage.shape != (*steps.shape[:-1], 1):
            raise ValueError(f"{names.advantage} must be {[*steps.shape[:-1], 1]}, got {list(advantage.shape)}")

        # Actions that were not executed must not reach the graph: 0 * NaN is NaN, also backwards.
        executed = steps.any(-1, keepdim=True) if whole else steps.unsqueeze(-1)
        taken = torch.where(executed, chunk, torch.zeros_like(chunk))  # tokens stay whole numbers
        tensordict.set(names.action, taken)  # an autoregressive actor reads them
        distribution = self._distribution(tensordict)
        if getattr(distribution, "whole_chunks", False):
            if self.ratio_level == "chunk":
                raise ValueError(
                    f'ratio_level="chunk" would take the ratio of a chunk once for each step: '
                    f'{type(distribution).__name__} has that of the chunk at every step, use "step"'
                )
            if _of_single_steps(before, steps):
                raise ValueError(
                    f"{names.sample_log_prob} differ from step to step, those of {type(distribution).__name__} do not: "
                    "collect and train with the same noise (policies.laplace_actor)"
                )
            taken = torch.where(executed.any(-2, keepdim=True), chunk, torch.zeros_like(chunk))
        now = distribution.log_prob(taken)
        if now.shape != before.shape:
            raise ValueError(
                f"{names.sample_log_prob} is {list(before.shape)}, the actor scores {list(now.shape)}: "
                "collect and train with the same event_dims"
            )
        if whole:
            return distribution, *self._whole_log_ratio(now - before, executed & ~padding, steps, advantage)
        return distribution, *self._log_ratio(now - before, steps, advantage)

    def _whole_log_ratio(
        self, difference: Tensor, said: Tensor, steps: Tensor, advantage: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`_log_ratio`, of the tokens of whole chunks: [*B, L] one by one, or [*B, C]."""
        if self.ratio_level not in ("chunk", "token"):
            raise ValueError(
                f"ratio_level must be chunk or token for tokens that belong to a whole chunk, got {self.ratio_level!r}"
            )
        difference = torch.where(said, difference, 0.0)
        if self.ratio_level == "token":
            return difference, said, advantage
        return difference.sum(-1, keepdim=True).expand(steps.shape), steps, advantage

    def _distribution(self, tensordict: TensorDictBase) -> Distribution:
        if self.actor_network_params is not None:
            with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
                return self.actor_network.get_dist(tensordict)
        return self.actor_network.get_dist(tensordict)

    def _executed(self, tensordict: TensorDictBase) -> Tensor:
        key = self.tensor_keys.step_mask
        steps = tensordict.get(("next", *((key,) if isinstance(key, str) else key)), None)
        if steps is None:
            steps = tensordict.get(key)
        mask = tensordict.get(self.tensor_keys.mask, None)
        return steps if mask is None else steps & mask.reshape(*steps.shape[:-1], 1)

    def _log_ratio(self, difference: Tensor, steps: Tensor, advantage: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-ratios, zero where nothing was executed, their mask and advantage: [*B, C], or [*B, C, 7] one by one."""
        if difference.ndim not in (steps.ndim, steps.ndim + 1):
            raise ValueError(f"log-probs must be [*B, C] or [*B, C, 7], got {list(difference.shape)}: use event_dims=1")
        each = difference.ndim == steps.ndim + 1
        if self.ratio_level in _EACH:
            if not each:
                remedy = "build the actor with event_dims=0"
                if self.ratio_level == "token":
                    remedy = "that is of an actor of tokens with event_dims=0, set_keys(action=keys.TOKENS)"
                raise ValueError(f"ratio_level={self.ratio_level!r} needs log-probs [*B, C, 7]: {remedy}")
            mask = steps.unsqueeze(-1).expand_as(difference)
            return torch.where(mask, difference, 0.0), mask, advantage.unsqueeze(-1)
        difference = torch.where(steps, difference.sum(-1) if each else difference, 0.0)
        if self.ratio_level == "chunk":
            difference = difference.sum(-1, keepdim=True).expand_as(steps)
        return difference, steps, advantage

    def _weight(self, tensordict: TensorDictBase, steps: Tensor, dtype: torch.dtype) -> Tensor:
        """What each executed step counts, broadcastable to ``[*B, C]``."""
        names = self.tensor_keys
        total = tensordict.get(names.total_steps, None)
        if self.normalize == "global":
            return 1 / (steps.sum().clamp_min(1) if total is None else total).to(dtype)
        rollouts = tensordict.get(names.num_rollouts, None)
        if total is None and rollouts is None and steps.ndim >= 3:  # [*rollouts, T, C]
            total = steps.sum((-2, -1), keepdim=True)
            rollouts = (total > 0).sum().clamp_min(1)
            total = total.clamp_min(1)
        if total is None or rollouts is None:
            raise ValueError(
                f"normalize='episode' needs {names.total_steps!r} (steps of the decision's rollout) and "
                f"{names.num_rollouts!r}, both [*B, 1], unless decisions are [*rollouts, T]"
            )
        return 1 / (total * rollouts).to(dtype)

    def _diagnostics(self, log_ratio: Tensor, mask: Tensor) -> dict[str, Tensor]:
        count = mask.sum().clamp_min(1)
        ratio = torch.where(mask, log_ratio.exp(), 0.0)
        low, high = self.clip_epsilon
        outside = ((ratio < 1 - low) | (ratio > 1 + high)) & mask
        return {
            "kl_approx": torch.where(mask, ratio - 1 - log_ratio, 0.0).sum() / count,
            "clip_fraction": outside.sum() / count,
            "ESS": ratio.sum().square() / ratio.square().sum().clamp_min(1e-12) / count,
        }


def _of_single_steps(log_probs: Tensor, steps: Tensor) -> bool:
    """Whether log-probs [*B, C] or [*B, C, 7] were not written by a density of whole chunks, which has the same number
    at every step."""
    if steps.shape[-1] < 2 or log_probs.ndim < steps.ndim or torch.compiler.is_compiling():
        return False
    counted = log_probs[steps.any(-1)]  # others may hold anything
    return not bool((counted == counted[:, :1]).all())
