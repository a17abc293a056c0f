"""How far success in imagination is success."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from worldenv_trl.metrics.classification import classification
from worldenv_trl.metrics.drift import drift
from worldenv_trl.metrics.groups import group_correlations
from worldenv_trl.metrics.success import paired_test

__all__ = ["advantage_correlation", "honesty", "rank_correlation"]


def honesty(
    imagined: Any,
    real: Any,
    *,
    imagined_steps: Any = None,
    real_steps: Any = None,
    policy: Any = None,
    imagined_frames: Tensor | None = None,
    real_frames: Tensor | None = None,
    length: Tensor | None = None,
) -> dict[str, Any]:
    """Compares what the same contexts (and actions) come to in imagination and in the physics.

    Args:
        imagined: bool ``[n]`` (tensor or array), success in imagination.
        real: bool ``[n]``, success in the physics.

    Keyword Args:
        imagined_steps, real_steps: ``[n]``, env steps until success; compared where both succeed.
        policy: ``[n]``, which policy each rollout is of: are better ones better in imagination, too?
        imagined_frames, real_frames, length: videos of the same actions, as :func:`~worldenv_trl.metrics.drift` takes
            them.

    Returns:
        ``n``, ``imagined`` and ``real`` (the success rates), ``precision``, ``recall`` and ``f1`` of imagined success,
        ``gap`` of the rates (imagined minus real) with a 95 % interval ``gap_low``, ``gap_high``; with steps
        ``stop_error``, the mean absolute difference, and ``stop_bias``, the mean difference (positive: imagination is
        late), both NaN where nothing succeeds in both; with policies ``rank_correlation`` of their success rates; with
        frames ``drift``, a dict of tensors over the horizon.

    Raises:
        ValueError: if the two differ in length or are empty.
    """
    imagined, real = torch.as_tensor(imagined).bool(), torch.as_tensor(real).bool()
    test = paired_test(real, imagined)
    figures = classification(imagined.float(), real)
    report: dict[str, Any] = {
        "n": len(real),
        "imagined": imagined.float().mean().item(),
        "real": real.float().mean().item(),
        "precision": figures.precision,
        "recall": figures.recall,
        "f1": figures.f1,
        "gap": test["difference"],
        "gap_low": test["low"],
        "gap_high": test["high"],
    }
    if imagined_steps is not None and real_steps is not None:
        both = imagined & real
        difference = (torch.as_tensor(imagined_steps).double() - torch.as_tensor(real_steps).double())[both]
        report["stop_error"] = difference.abs().mean().item()  # the mean of nothing is NaN
        report["stop_bias"] = difference.mean().item()
    if policy is not None:
        policy = torch.as_tensor(policy)
        rates = [[side[policy == name].double().mean() for name in policy.unique()] for side in (imagined, real)]
        report["rank_correlation"] = rank_correlation(*(torch.stack(side) for side in rates))
    if imagined_frames is not None and real_frames is not None:
        report["drift"] = drift(imagined_frames, real_frames, length)
    return report


def advantage_correlation(returns: Any, real: Any) -> tuple[float, int]:
    """How much of what a group learns from is so: the mean of :func:`~worldenv_trl.metrics.group_correlations`.

    Args:
        returns: ``[G, N]`` of N imagined rollouts of each of G contexts.
        real: bool ``[G, N]``, whether the physics reaches the goal under the same actions.

    Returns:
        The mean of Pearson's correlation over the groups in which some rollouts succeed and some fail, 0 where all
        returns are equal, and the number of these groups; NaN if there is none.

    Raises:
        ValueError: if they are not both [G, N].
    """
    returns, real = torch.as_tensor(returns).double(), torch.as_tensor(real).double()
    if returns.shape != real.shape or returns.ndim != 2:
        raise ValueError(f"returns and real must both be [G, N], got {list(returns.shape)} and {list(real.shape)}")
    each = group_correlations(returns, real)
    return each.nanmean().item(), int(each.isfinite().sum())


def rank_correlation(first: Any, second: Any) -> float:
    """Spearman's rank correlation of two lists ``[n]``, ties sharing their mean rank; NaN if one of them is constant.

    Raises:
        ValueError: if the two differ in length or hold fewer than two values.
    """
    first, second = torch.as_tensor(first).double(), torch.as_tensor(second).double()
    if first.shape != second.shape or first.ndim != 1 or len(first) < 2:
        raise ValueError(
            f"a rank correlation needs two lists [n], n >= 2, got {list(first.shape)} and {list(second.shape)}"
        )
    x, y = (_ranks(values) for values in (first, second))
    x, y = x - x.mean(), y - y.mean()
    scale = (x.square().sum() * y.square().sum()).sqrt()
    return float((x * y).sum() / scale) if scale > 0 else float("nan")


def _ranks(values: Tensor) -> Tensor:
    _, inverse, counts = values.unique(return_inverse=True, return_counts=True)
    return (counts.cumsum(0).double() - (counts.double() - 1) / 2)[inverse]
