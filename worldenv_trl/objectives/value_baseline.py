"""A learned baseline of LOOP: how likely a rollout that stands here is to succeed, and what each decision changed."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.objectives.value.functional import generalized_advantage_estimate

__all__ = ["ValueBaseline", "baseline_advantage"]


class ValueBaseline(nn.Module):
    """V(o_t): the expected return of a rollout, of features of the decision at which it stands.

    A leave-one-out advantage gives every decision of a rollout the same credit although one grasp decides. Where the
    chances are known before and after a decision, their difference is its own (Schulman et al., "High-dimensional
    continuous control using generalized advantage estimation", 2016).

    Args:
        features: F, for instance of :class:`~worldenv_trl.policies.Hidden`.
        width: of its one hidden layer.
        dropout: on features and hidden layer while it learns.

    Examples:
        >>> value = ValueBaseline(16)
        >>> features, returns = torch.randn(64, 16), torch.rand(64)
        >>> value.normalize(features)
        >>> value.loss(features, returns).backward()
        >>> value.eval()(features).shape
        torch.Size([64])
    """

    center: Tensor
    spread: Tensor

    def __init__(self, features: int, width: int = 256, dropout: float = 0.3) -> None:
        super().__init__()
        if features < 1 or width < 1 or not 0 <= dropout < 1:
            raise ValueError(
                f"features and width must be at least 1 and dropout in [0, 1), got {features}, {width} and {dropout}"
            )
        self.register_buffer("center", torch.zeros(features))
        self.register_buffer("spread", torch.ones(features))
        self.network = nn.Sequential(
            nn.Dropout(dropout), nn.Linear(features, width), nn.ReLU(), nn.Dropout(dropout), nn.Linear(width, 1)
        )

    @torch.no_grad()
    def normalize(self, features: Tensor) -> None:
        """Takes from features [M, F] what brings each to mean 0 and deviation 1."""
        self.center.copy_(features.mean(0))
        self.spread.copy_(features.std(0) + 1e-3)  # what is always the same stays near 0

    def forward(self, features: Tensor) -> Tensor:
        """[*B, F] -> the expected return [*B], in (0, 1)."""
        return self._log_odds(features).sigmoid()

    def loss(self, features: Tensor, returns: Tensor) -> Tensor:
        """Binary cross-entropy with returns [M] in [0, 1] of the rollouts that the decisions [M, F] belong to."""
        return F.binary_cross_entropy_with_logits(self._log_odds(features), returns)

    def _log_odds(self, features: Tensor) -> Tensor:
        return self.network((features - self.center) / self.spread).squeeze(-1)


def baseline_advantage(returns: Tensor, values: Tensor, mask: Tensor, lmbda: float) -> Tensor:
    """What each decision changed: the sum of what V changes by from it on, ``lmbda`` to the power of how much later.

    The return counts where V would be after the last decision. With ``lmbda`` 1 it is the return less V, without bias
    whatever V is; the smaller it is, the less of what later decisions did is in it, and the more V has to be right.

    Args:
        returns: [*B], of rollouts.
        values: [*B, T], V at each decision, of what has not seen this rollout's return.
        mask: bool [*B, T], which decisions the rollout has: the first ones, one at least.
        lmbda: in [0, 1].

    Returns:
        [*B, T], 0 outside the mask.

    Raises:
        ValueError: for shapes that do not match, a rollout without decisions, or ``lmbda`` out of range.

    Examples:
        >>> returns, values = torch.tensor([1.0, 0.0]), torch.tensor([[0.5, 0.8], [0.5, 0.25]])
        >>> baseline_advantage(returns, values, torch.tensor([[True, True], [True, False]]), 0.0)
        tensor([[ 0.3000,  0.2000],
                [-0.5000,  0.0000]])
    """
    if values.shape != mask.shape or values.shape[:-1] != returns.shape:
        raise ValueError(
            f"values and mask must be [*B, T] of returns [*B], got {list(values.shape)}, {list(mask.shape)} and "
            f"{list(returns.shape)}"
        )
    if not 0 <= lmbda <= 1:
        raise ValueError(f"lmbda must be in [0, 1], got {lmbda}")
    count = mask.sum(-1, keepdim=True)
    last = torch.arange(mask.shape[-1], device=mask.device) == count - 1
    if not last.any(-1).all() or (mask != (torch.arange(mask.shape[-1], device=mask.device) < count)).any():
        raise ValueError("mask must hold the first decisions of every rollout, one at least")
    values = torch.where(mask, values, 0.0)
    shifted = torch.cat([values[..., 1:], values[..., -1:]], -1)
    reward = torch.where(last, returns.unsqueeze(-1), 0.0)
    done = (last | ~mask).unsqueeze(-1)
    advantage, _ = generalized_advantage_estimate(
        1.0, lmbda, values.unsqueeze(-1), shifted.unsqueeze(-1), reward.unsqueeze(-1), done
    )
    return torch.where(mask, advantage.squeeze(-1), 0.0)
