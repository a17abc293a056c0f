"""The stochastic actor: a policy's Laplace parameters as a TorchRL ``ProbabilisticActor``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from worldenv_trl.keys import CHUNK, LOC, LOG_PROBS, LOG_SCALE, SCALE
from worldenv_trl.policies.autoregressive import AutoregressiveActor
from worldenv_trl.policies.base import Policy
from worldenv_trl.policies.chunk_laplace import ChunkLaplace
from worldenv_trl.policies.laplace import IndependentLaplace
from worldenv_trl.policies.token_policy import TokenPolicy

__all__ = ["LaplaceActor", "laplace_actor", "likelihood_actor", "policy_actor", "scale_bounds"]

Bound = float | Sequence[float]
NOISES = {"step": IndependentLaplace, "chunk": ChunkLaplace}


class _Scale(nn.Module):
    """From what a policy writes to what is sampled from: ``scale = exp(clamp(log_scale)) * scale_factor``."""

    log_scale_low: Tensor | None
    log_scale_high: Tensor | None
    scale_factor: Tensor

    def __init__(self, scale_factor: float, log_scale_bounds: tuple[Tensor, Tensor] | None) -> None:
        super().__init__()
        low, high = (None, None) if log_scale_bounds is None else log_scale_bounds
        self.register_buffer("log_scale_low", low, persistent=False)
        self.register_buffer("log_scale_high", high, persistent=False)
        # A buffer: losses that hold a functional copy of this module share it and follow in-place changes.
        self.register_buffer("scale_factor", torch.tensor(scale_factor), persistent=False)

    def forward(self, loc: Tensor, log_scale: Tensor) -> tuple[Tensor, Tensor]:
        bounded = log_scale if self.log_scale_low is None else log_scale.clamp(self.log_scale_low, self.log_scale_high)
        return loc, bounded.exp() * self.scale_factor


class LaplaceActor(ProbabilisticActor):
    """``ProbabilisticActor`` over action chunks; the density it samples from is the density it scores."""

    @property
    def policy(self) -> Policy:
        return self.module[0][0]

    def get_dist(self, *args: Any, **kwargs: Any) -> IndependentLaplace:
        """The density that losses score; acting does without it.

        Raises:
            RuntimeError: for a policy that cannot learn.
        """
        self.policy.require_gradients()
        return super().get_dist(*args, **kwargs)

    @property
    def scale_factor(self) -> float:
        """What the learned scale is multiplied with, for sampling and for scoring alike."""
        return self._scale.scale_factor.item()

    def set_scale_factor(self, scale_factor: float) -> None:
        """Changes the exploration width in place, also for losses already built on this actor."""
        self._scale.scale_factor.fill_(_positive(scale_factor))

    @property
    def _scale(self) -> _Scale:
        return self.module[0][1].module


def scale_bounds(
    policy: Policy, floor: tuple[float, float, float] = (0.04, 0.0025, 0.15), share: float = 0.125
) -> tuple[list[float], float]:
    """Bounds of the log-scale within which a policy explores, for :func:`laplace_actor`.

    A scale that was learned on a few demonstrations tells what is left of the error there, a tenth of what it is on new
    scenes: the rollouts of a group then end alike and LOOP learns nothing. So the scale of a dimension is no less than
    ``floor``, and no less than ``share`` of the range that the training uses of it: where the demonstrations turn the
    hand, noise that suits rotations they never use is so small that the smallest update goes too far.

    Args:
        policy: whose :attr:`~worldenv_trl.policies.Policy.action_range` counts.
        floor: of the scale of position, rotation and gripper, in normalised action units.
        share: of the policy's action range, from 0 (the floor alone) to 1.

    Returns:
        The lower bound of each of the 7 dimensions, and one upper bound (-1.5, and above every lower one).

    Raises:
        ValueError: for a floor that is not positive, or a share outside [0, 1].

    Examples:
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy
        >>> policy = OFTPolicy(OFTConfig(instructions=("open the drawer",)))
        >>> low, high = scale_bounds(policy, floor=(0.04, 0.0025, 0.15), share=0.0)
        >>> [round(math.exp(bound), 4) for bound in low]
        [0.04, 0.04, 0.04, 0.0025, 0.0025, 0.0025, 0.15]
        >>> actor = laplace_actor(policy, log_scale_bounds=(low, high))
    """
    if not all(math.isfinite(value) and value > 0 for value in floor):
        raise ValueError(f"floor must be positive, got {floor}")
    if not 0 <= share <= 1:
        raise ValueError(f"share must lie between 0 and 1, got {share}")
    position, rotation, gripper = floor
    floors = torch.tensor([*3 * [position], *3 * [rotation], gripper])
    low = torch.maximum(floors, share * policy.action_range.cpu()).log().tolist()
    return low, max(-1.5, *(bound + 1 for bound in low))


def laplace_actor(
    policy: Policy,
    *,
    event_dims: int = 1,
    scale_factor: float = 1.0,
    log_scale_bounds: tuple[Bound, Bound] | None = (-6.0, -1.5),
    noise: str = "step",
    loc_key: NestedKey = LOC,
    scale_key: NestedKey = SCALE,
) -> LaplaceActor:
    """Wraps a policy: ``TensorDictSequential(policy, scale)`` inside TorchRL's ``ProbabilisticActor``.

    Reads what the policy reads; writes ``LOC``, ``LOG_SCALE``, ``SCALE = exp(clamp(log_scale)) * scale_factor``,
    ``CHUNK`` (the mode under ``ExplorationType.DETERMINISTIC``) and ``LOG_PROBS`` ([*B, C] for ``event_dims=1``). The
    clamp and the factor are part of the density: behaviour and scored log-probabilities agree.

    Args:
        policy: a :class:`~worldenv_trl.policies.Policy`.
        event_dims: trailing dimensions of ``[*B, C, 7]`` summed in the log-probability.
        scale_factor: exploration width relative to the trained scale, positive.
        log_scale_bounds: where the log-scale is clamped: (low, high), each one number or one for each action
            dimension, or None. Its gradient is zero outside. The lower bound is what exploration lives on: see
            :func:`scale_bounds`.
        noise: ``step``, each step of a chunk has its own (World-Env Eq. 2, :class:`IndependentLaplace`), or ``chunk``,
            one for all of them (:class:`ChunkLaplace`).
        loc_key, scale_key: ``BCLoss`` takes the negative log-likelihood only of actors that write keys named plainly
            ``"loc"`` or ``"scale"`` (it falls back to squared errors of the mode, silently): for the scale-head stage
            use :func:`likelihood_actor`.

    Raises:
        TypeError: for what is not a policy, and for one that acts by tokens: see :func:`policy_actor`.
        ValueError: for bounds of which the lower one is not below the upper one, a factor that is not positive, or
            another ``noise``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy
        >>> policy = OFTPolicy(OFTConfig(instructions=("open the drawer",)))
        >>> actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
        >>> observation = {"image": torch.zeros(5, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(5, 7)}
        >>> out = actor(TensorDict({"observation": observation, "language_instruction": "open the drawer"}, [5]))
        >>> out["vla_action", "chunk"].shape, out["vla_action", "log_probs"].shape
        (torch.Size([5, 8, 7]), torch.Size([5, 8]))
    """
    if not isinstance(policy, Policy):
        raise TypeError(f"policy must be a worldenv_trl.policies.Policy, got {type(policy).__name__}")
    if isinstance(policy, TokenPolicy):
        raise TypeError(f"{type(policy).__name__} acts by tokens and has no Laplace density: use policy_actor")
    if noise not in NOISES:
        raise ValueError(f"noise must be one of {', '.join(NOISES)}, got {noise!r}")
    scale_factor = _positive(scale_factor)
    bounds = None
    if log_scale_bounds is not None:
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in log_scale_bounds)
        if not (low < high).all():
            raise ValueError(f"log_scale_bounds must be (low, high) with low < high, got {log_scale_bounds}")
        bounds = (low, high)
    scale = _Scale(scale_factor, bounds).to(policy.action_range.device)
    module = TensorDictSequential(
        policy, TensorDictModule(scale, in_keys=[LOC, LOG_SCALE], out_keys=[loc_key, scale_key])
    )
    return LaplaceActor(
        module,
        in_keys={"loc": loc_key, "scale": scale_key},
        out_keys=[CHUNK],
        distribution_class=NOISES[noise],
        distribution_kwargs={"event_dims": event_dims},
        return_log_prob=True,
        log_prob_key=LOG_PROBS,
    )


def policy_actor(
    policy: Policy,
    *,
    scale_factor: float = 1.0,
    log_scale_bounds: tuple[Bound, Bound] | None = (-6.0, -1.5),
    event_dims: int = 1,
    noise: str = "step",
) -> LaplaceActor | AutoregressiveActor:
    """The stochastic actor of any policy: :func:`laplace_actor`, or :class:`AutoregressiveActor` of one that acts by
    tokens.

    Args:
        policy: a :class:`~worldenv_trl.policies.Policy`.

    Keyword Args:
        scale_factor: exploration width relative to the policy's own, positive: of the Laplace scale, or of the
            temperature.
        log_scale_bounds: of the Laplace scale; without meaning for tokens.
        event_dims: of the log-probabilities, see both.
        noise: of the Laplace density, see :func:`laplace_actor`; without meaning for tokens.

    Raises:
        TypeError: for what is not a policy.
        ValueError: see both.
    """
    if isinstance(policy, TokenPolicy):
        temperature = policy.temperature * _positive(scale_factor)
        return AutoregressiveActor(policy, temperature=temperature, event_dims=event_dims)
    return laplace_actor(
        policy, event_dims=event_dims, scale_factor=scale_factor, log_scale_bounds=log_scale_bounds, noise=noise
    )


def likelihood_actor(policy: Policy) -> LaplaceActor:
    """The same density without clamp, under key names for which ``BCLoss`` computes the Laplace NLL (World-Env Eq. 8).

    ``BCLoss(likelihood_actor(policy))`` with ``set_keys(action=CHUNK, pad_mask=ACTION_IS_PAD)`` is the mean over
    unpadded steps of ``sum_d |a_d - mu_d| / exp(beta_d) + beta_d + log 2``.

    Examples:
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy
        >>> actor = likelihood_actor(OFTPolicy(OFTConfig(instructions=("open the drawer",))))
        >>> {"loc", "scale"} <= set(actor.out_keys)
        True
    """
    return laplace_actor(policy, log_scale_bounds=None, loc_key="loc", scale_key="scale")


def _positive(scale_factor: float) -> float:
    if not (math.isfinite(scale_factor) and scale_factor > 0):
        raise ValueError(
            f"scale_factor must be positive, got {scale_factor}; for greedy actions use ExplorationType.DETERMINISTIC"
        )
    return float(scale_factor)
