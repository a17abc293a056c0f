"""Leave-one-out advantage (World-Env Eq. 4; Kool et al., "Buy 4 REINFORCE Samples, Get a Baseline for Free!", 2019)."""

from __future__ import annotations

from torch import Tensor


def rloo_advantage(returns: Tensor) -> Tensor:
    """Each return minus the mean of the other returns of its group.

    Args:
        returns: ``[..., N]``, the ``N`` rollouts of a group (one initial state) last.

    Returns:
        ``[..., N]``; sums to zero over each group, and is not divided by a standard deviation.

    Raises:
        ValueError: if a group has fewer than two rollouts, or a return is not finite.

    Examples:
        >>> import torch
        >>> rloo_advantage(torch.tensor([1.0, 0.0, 0.5]))
        tensor([ 0.7500, -0.7500,  0.0000])
    """
    if returns.ndim == 0 or returns.shape[-1] < 2:
        raise ValueError(
            f"leave-one-out needs at least 2 rollouts in a group, got returns of shape {list(returns.shape)}"
        )
    if unknown := int((~returns.isfinite()).sum()):
        raise ValueError(f"returns must be finite, {unknown} of {returns.numel()} are not")
    n = returns.shape[-1]
    return (returns - returns.mean(-1, keepdim=True)) * (n / (n - 1))
