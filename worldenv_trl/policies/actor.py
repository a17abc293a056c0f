"""The stochastic actor: a policy's Laplace parameters as a TorchRL ``ProbabilisticActor``."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn
from torchrl.modules import ProbabilisticActor

from worldenv_trl.keys import CHUNK, IMAGE, LOC, LOG_PROBS, LOG_SCALE, SCALE, STATE, TASK_ID
from worldenv_trl.policies.laplace import IndependentLaplace

Bound = float | Sequence[float]


class _LaplaceParameters(nn.Module):
    def __init__(self, policy: nn.Module, scale_factor: float, log_scale_bounds: tuple[Bound, Bound] | None):
        super().__init__()
        self.policy = policy
        low, high = (None, None) if log_scale_bounds is None else map(torch.as_tensor, log_scale_bounds)
        self.register_buffer("log_scale_low", low, persistent=False)
        self.register_buffer("log_scale_high", high, persistent=False)
        # A buffer: losses that hold a functional copy of this module share it and follow in-place changes.
        self.register_buffer("scale_factor", torch.tensor(float(scale_factor)), persistent=False)

    def forward(
        self, image: torch.Tensor, state: torch.Tensor, task_id: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        loc, log_scale = self.policy(image, state, task_id)
        bounded = log_scale if self.log_scale_low is None else log_scale.clamp(self.log_scale_low, self.log_scale_high)
        return loc, log_scale, bounded.exp() * self.scale_factor


class LaplaceActor(ProbabilisticActor):
    """``ProbabilisticActor`` over action chunks; the density it samples from is the density it scores."""

    @property
    def policy(self) -> nn.Module:
        return self.module[0].module.policy

    @property
    def scale_factor(self) -> float:
        """What the learned scale is multiplied with, for sampling and for scoring alike."""
        return self.module[0].module.scale_factor.item()

    def set_scale_factor(self, scale_factor: float) -> None:
        """Changes the exploration width in place, also for losses already built on this actor."""
        self.module[0].module.scale_factor.fill_(_positive(scale_factor))


def laplace_actor(
    policy: nn.Module,
    *,
    event_dims: int = 1,
    scale_factor: float = 1.0,
    log_scale_bounds: tuple[Bound, Bound] | None = (-6.0, -1.5),
    loc_key: NestedKey = LOC,
    scale_key: NestedKey = SCALE,
) -> LaplaceActor:
    """Wraps a policy ``(image, state, task_id) -> (loc, log_scale)``.

    Reads ``IMAGE``, ``STATE`` and ``TASK_ID``; writes ``LOC``, ``LOG_SCALE``, ``SCALE = exp(clamp(log_scale)) *
    scale_factor``, ``CHUNK`` (the mode under ``ExplorationType.DETERMINISTIC``) and ``LOG_PROBS`` (``[*B, C]`` for
    ``event_dims=1``). The clamp and the factor are part of the density: behaviour and scored log-probabilities agree.

    Args:
        policy: for example :class:`~worldenv_trl.policies.OFTPolicy`.
        event_dims: trailing dimensions of ``[*B, C, 7]`` summed in the log-probability.
        scale_factor: exploration width relative to the trained scale, positive.
        log_scale_bounds: where the log-scale is clamped: (low, high), each one number or one for each action
            dimension, or None. Its gradient is zero outside. A scale head that has learned the residuals on a few
            demonstrations is far too sure of itself (a tenth of the error on new scenes): the lower bound is what
            exploration lives on.
        loc_key, scale_key: ``BCLoss`` takes the negative log-likelihood only of actors that write keys named plainly
            ``"loc"`` or ``"scale"`` (it falls back to squared errors of the mode, silently): for the scale-head stage
            use :func:`likelihood_actor`.
    """
    scale_factor = _positive(scale_factor)
    if log_scale_bounds is not None:
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in log_scale_bounds)
        if not (low < high).all():
            raise ValueError(f"log_scale_bounds must be (low, high) with low < high, got {log_scale_bounds}")
        log_scale_bounds = (low, high)
    module = TensorDictModule(
        _LaplaceParameters(policy, scale_factor, log_scale_bounds),
        in_keys=[IMAGE, STATE, TASK_ID],
        out_keys=[loc_key, LOG_SCALE, scale_key],
    )
    return LaplaceActor(
        module,
        in_keys={"loc": loc_key, "scale": scale_key},
        out_keys=[CHUNK],
        distribution_class=IndependentLaplace,
        distribution_kwargs={"event_dims": event_dims},
        return_log_prob=True,
        log_prob_key=LOG_PROBS,
    )


def likelihood_actor(policy: nn.Module) -> LaplaceActor:
    """The same density without clamp, under key names for which ``BCLoss`` computes the Laplace NLL (World-Env Eq. 8).

    ``BCLoss(likelihood_actor(policy))`` with ``set_keys(action=CHUNK, pad_mask=ACTION_IS_PAD)`` is the mean over
    unpadded steps of ``sum_d |a_d - mu_d| / exp(beta_d) + beta_d + log 2``.
    """
    return laplace_actor(policy, log_scale_bounds=None, loc_key="loc", scale_key="scale")


def _positive(scale_factor: float) -> float:
    if not (math.isfinite(scale_factor) and scale_factor > 0):
        raise ValueError(
            f"scale_factor must be positive, got {scale_factor}; for greedy actions use ExplorationType.DETERMINISTIC"
        )
    return float(scale_factor)
