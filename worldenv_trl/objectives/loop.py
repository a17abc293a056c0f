"""LOOP: leave-one-out PPO on action chunks (World-Env section 3.4, Eq. 4-5; RIPT-VLA, arXiv 2505.17016)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from worldenv_trl import keys

__all__ = ["LOOPLoss"]

RATIO_LEVELS = ("step", "chunk", "dim")
NORMALIZATIONS = ("global", "episode")


class LOOPLoss(LossModule):
    r"""Clipped surrogate of World-Env Eq. 5,

    .. math:: L = -\frac{1}{\sum_n T_n} \sum_n \sum_{t \le T_n} \min(r_t A_n, \mathrm{clip}(r_t, 1-\epsilon, 1+\epsilon) A_n),

    over the executed steps ``t`` of rollouts ``n``; ``r_t`` is the probability ratio of step ``t``'s action. Steps of a chunk
    after a stop (``step_mask`` False), and decisions that belong to no rollout (``("collector", "mask")`` False), do not
    count, in value or gradient.

    Reads decisions ``[*B]``: the actor's inputs, ``("vla_action", "chunk")`` [*B, C, 7], ``("vla_action", "log_probs")``
    [*B, C], ``advantage`` [*B, 1], ``step_mask`` [*B, C], optionally ``("collector", "mask")`` [*B] and ``total_steps``
    [*B, 1]: the executed steps of the whole batch (``normalize="global"``) or of the decision's own rollout
    (``"episode"``). With it, the losses of minibatches, or of processes, add up exactly to the loss of the whole batch;
    without it, the steps at hand are counted.

    Returns ``loss_objective`` (scalar), and detached ``kl_approx`` (mean of ``(r - 1) - log r`` per step), ``clip_fraction``,
    ``ESS`` (effective sample size as a share of the steps).

    Args:
        actor: writes a distribution over chunks whose log-prob is [*B, C] (``event_dims=1``).

    Keyword Args:
        clip_epsilon: ``epsilon``, or ``(low, high)``.
        ratio_level: ``step`` (the paper); ``chunk``: one ratio for the executed steps of a chunk, counted once for each of
            them; ``dim``: one for each action dimension, averaged (needs log-probs [*B, C, 7], ``event_dims=0``).
        normalize: ``global`` (the paper) weighs every step equally, ``episode`` every rollout. The latter needs
            ``total_steps`` and divides by the number of rollouts, ``num_rollouts`` [*B, 1].
        functional: False keeps the actor's parameters in the actor (needed for adapters injected by peft, and FSDP).

    Raises:
        ValueError: for a setting out of range, or entries whose shapes do not match.

    Examples:
        >>> loss = LOOPLoss(actor, clip_epsilon=0.1)
        >>> loss(decisions)["loss_objective"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        advantage: NestedKey = keys.ADVANTAGE
        action: NestedKey = keys.CHUNK
        sample_log_prob: NestedKey = keys.LOG_PROBS
        step_mask: NestedKey = keys.STEP_MASK
        mask: NestedKey = keys.MASK
        total_steps: NestedKey = "total_steps"
        num_rollouts: NestedKey = "num_rollouts"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams | None
    target_actor_network_params: TensorDictParams | None
    out_keys: ClassVar[list[str]] = ["loss_objective", "kl_approx", "clip_fraction", "ESS"]

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        *,
        clip_epsilon: float | tuple[float, float] = 0.1,
        ratio_level: str = "step",
        normalize: str = "global",
        functional: bool = True,
    ) -> None:
        if ratio_level not in RATIO_LEVELS:
            raise ValueError(f"ratio_level must be one of {', '.join(RATIO_LEVELS)}, got {ratio_level!r}")
        if normalize not in NORMALIZATIONS:
            raise ValueError(f"normalize must be one of {', '.join(NORMALIZATIONS)}, got {normalize!r}")
        low, high = clip_epsilon if isinstance(clip_epsilon, tuple | list) else (clip_epsilon, clip_epsilon)
        if not (0 < low < 1 and high > 0):
            raise ValueError(f"clip_epsilon must be positive (and below 1 downwards), got {clip_epsilon}")
        self._functional = functional
        super().__init__()
        if functional:
            self.convert_to_functional(actor, "actor_network", create_target_params=False)
        else:
            self.actor_network, self.actor_network_params = actor, None
        self.ratio_level, self.normalize = ratio_level, normalize
        self.register_buffer("clip_epsilon", torch.tensor([float(low), float(high)]))

    @property
    def functional(self) -> bool:
        return self._functional

    def _forward_value_estimator_keys(self, **_: object) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        names = self.tensor_keys
        own = [names.action, names.sample_log_prob, names.advantage, names.step_mask]
        return [*own, *(key for key in self.actor_network.in_keys if key not in own)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        names = self.tensor_keys
        tensordict = tensordict.copy()
        chunk, before = tensordict.get(names.action), tensordict.get(names.sample_log_prob)
        if before.requires_grad:
            raise ValueError(f"{names.sample_log_prob} requires grad: collect rollouts under torch.no_grad()")
        distribution = self._distribution(tensordict)
        now = distribution.log_prob(chunk)
        if now.shape != before.shape:
            raise ValueError(
                f"{names.sample_log_prob} is {list(before.shape)}, the actor scores {list(now.shape)}: "
                "collect and train with the same event_dims"
            )
        steps = self._executed(tensordict)  # [*B, C]
        advantage = tensordict.get(names.advantage)
        if advantage.shape != (*steps.shape[:-1], 1):
            raise ValueError(f"{names.advantage} must be {[*steps.shape[:-1], 1]}, got {list(advantage.shape)}")

        log_ratio = now - before
        if self.ratio_level == "dim":
            if log_ratio.ndim != steps.ndim + 1:
                raise ValueError("ratio_level='dim' needs log-probs [*B, C, 7]: build the actor with event_dims=0")
            advantage = advantage.unsqueeze(-1)
            mask = steps.unsqueeze(-1).expand_as(log_ratio)
        else:
            if log_ratio.ndim == steps.ndim + 1:
                log_ratio = log_ratio.sum(-1)
            mask = steps
        # Steps that were not executed must not reach the graph, not even as 0 * inf.
        log_ratio = torch.where(mask, log_ratio, torch.zeros_like(log_ratio))
        if self.ratio_level == "chunk":
            log_ratio = log_ratio.sum(-1, keepdim=True).expand_as(steps)
        ratio = log_ratio.exp()
        low, high = self.clip_epsilon
        clipped = ratio.clamp(1 - low, 1 + high)
        gain = torch.minimum(ratio * advantage, clipped * advantage)
        if self.ratio_level == "dim":
            gain = gain.mean(-1)
        gain = torch.where(steps, gain, torch.zeros_like(gain)) * self._weight(tensordict, steps)
        out = {"loss_objective": -gain.sum()} | self._diagnostics(log_ratio.detach(), mask)
        return TensorDict(out)

    def _distribution(self, tensordict: TensorDictBase):
        if self.functional:
            with self.actor_network_params.to_module(self.actor_network):
                return self.actor_network.get_dist(tensordict)
        return self.actor_network.get_dist(tensordict)

    def _executed(self, tensordict: TensorDictBase) -> Tensor:
        steps = tensordict.get(self.tensor_keys.step_mask)
        mask = tensordict.get(self.tensor_keys.mask, None)
        return steps if mask is None else steps & mask.reshape(*steps.shape[:-1], 1)

    def _weight(self, tensordict: TensorDictBase, steps: Tensor) -> Tensor:
        """What each executed step counts, broadcastable to ``[*B, C]``."""
        names = self.tensor_keys
        total = tensordict.get(names.total_steps, None)
        if self.normalize == "global":
            return 1 / (steps.sum().clamp_min(1) if total is None else total).to(torch.float32)
        rollouts = tensordict.get(names.num_rollouts, None)
        if total is None or rollouts is None:
            raise ValueError(
                f"normalize='episode' needs {names.total_steps!r} (steps of the decision's rollout) and {names.num_rollouts!r}, both [*B, 1]"
            )
        return 1 / (total * rollouts).to(torch.float32)

    def _diagnostics(self, log_ratio: Tensor, mask: Tensor) -> dict[str, Tensor]:
        count = mask.sum().clamp_min(1)
        ratio = log_ratio.exp()
        low, high = self.clip_epsilon
        outside = ((ratio < 1 - low) | (ratio > 1 + high)) & mask
        weight = torch.where(mask, ratio, torch.zeros_like(ratio))
        return {
            "kl_approx": torch.where(mask, ratio - 1 - log_ratio, torch.zeros_like(ratio)).sum() / count,
            "clip_fraction": outside.sum() / count,
            "ESS": weight.sum().square() / weight.square().sum().clamp_min(1e-12) / count,
        }
