"""What returns tell inside the groups that a leave-one-out baseline compares, with intervals over groups."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Estimate", "group_bootstrap", "group_correlations", "group_slope"]

_EQUAL = 1e-12  # returns of a group whose summed squared distances from their mean are below this are all equal


def group_correlations(returns: Tensor, real: Tensor) -> Tensor:
    """Pearson's correlation of returns and real success inside each group: how much of what it teaches is so.

    A leave-one-out advantage compares the rollouts of one context with each other; the difference between contexts,
    which makes precision and recall look good, is no part of it.

    Args:
        returns: ``[*B, N]`` of the N rollouts of each group.
        real: bool ``[*B, N]``, whether the physics reaches the goal under the same actions.

    Returns:
        float64 ``[*B]``: 0 where some rollouts succeed and some fail but all returns are equal, so that nothing is
        learned; NaN where all rollouts come to the same, so that there is nothing to tell.

    Raises:
        ValueError: if the two differ in shape.

    Examples:
        >>> real = torch.tensor([[True, False, True, False], [True, False, True, False], [True, True, True, True]])
        >>> returns = torch.tensor([[0.9, 0.1, 0.9, 0.1], [0.5, 0.5, 0.5, 0.5], [0.9, 0.1, 0.9, 0.1]])
        >>> group_correlations(returns, real)
        tensor([1., 0., nan], dtype=torch.float64)
    """
    x, y = _centred(returns, real)
    mixed = y.square().sum(-1) > 0
    scale = (x.square().sum(-1) * y.square().sum(-1)).sqrt()
    correlation = torch.where(x.square().sum(-1) > _EQUAL, (x * y).sum(-1) / scale, 0.0)
    return torch.where(mixed, correlation, torch.nan)


def group_slope(returns: Tensor, real: Tensor) -> Tensor:
    """Real success that a unit of return is worth inside a group: the pooled least-squares slope within groups.

    What advantages would have to be multiplied with to promise neither too much nor too little.

    Args:
        returns: ``[*B, G, N]`` of N rollouts of each of G groups.
        real: bool ``[*B, G, N]``.

    Returns:
        float64 ``[*B]``; NaN where the returns of every group are equal.

    Raises:
        ValueError: if the two differ in shape.
    """
    x, y = _centred(returns, real)
    spread = x.square().sum((-2, -1))
    return torch.where(spread > _EQUAL, (x * y).sum((-2, -1)) / spread, torch.nan)


def _centred(returns: Tensor, real: Tensor) -> tuple[Tensor, Tensor]:
    if returns.shape != real.shape or returns.ndim < 2:
        raise ValueError(f"returns and real must both be [*B, G, N], got {list(returns.shape)} and {list(real.shape)}")
    returns, real = returns.double(), real.double()
    return returns - returns.mean(-1, keepdim=True), real - real.mean(-1, keepdim=True)


@dataclass(frozen=True)
class Estimate:
    """A figure and its interval; NaN where it cannot be said."""

    value: float
    low: float
    high: float


def group_bootstrap(
    figure: Callable[..., Tensor],
    *columns: Tensor,
    strata: Tensor | None = None,
    resamples: int = 1000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Estimate:
    """A figure of G groups with the percentile interval of a bootstrap over groups (Efron & Tibshirani 1993, ch. 13).

    Rollouts of a group share their context and are no independent samples: whole groups are drawn again. Calls with the
    same seed, strata and resamples draw the same groups, so that figures of the same groups can be compared pair by
    pair.

    Args:
        figure: of columns ``[*B, G, ...]`` -> ``[*B]``, NaN where it cannot be said.
        columns: ``[G, ...]`` each.

    Keyword Args:
        strata: int64 ``[G]``; groups are drawn within each, so that it keeps its number. One stratum when None.
        resamples: at least 1.
        confidence: in (0, 1).
        seed: of the draws.

    Returns:
        The figure, and the interval of its values over the resamples where it can be said.

    Raises:
        ValueError: if the columns differ in G or there is none, or settings are out of range.

    Examples:
        >>> values = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
        >>> group_bootstrap(lambda column: column.mean((-2, -1)), values).value
        1.5
    """
    if not columns or len({len(column) for column in columns}) > 1 or not len(columns[0]):
        raise ValueError(f"columns must have the same number of groups, got {[len(column) for column in columns]}")
    if resamples < 1 or not 0 < confidence < 1:
        raise ValueError(
            f"need resamples >= 1 and confidence in (0, 1), got resamples={resamples}, confidence={confidence}"
        )
    count = len(columns[0])
    strata = torch.zeros(count, dtype=torch.int64) if strata is None else strata.reshape(count)
    generator = torch.Generator().manual_seed(seed)
    drawn = []
    for number in strata.unique():
        members = (strata == number).nonzero().squeeze(-1)
        drawn.append(members[torch.randint(len(members), (resamples, len(members)), generator=generator)])
    rows = torch.cat(drawn, 1)  # [resamples, G]
    value = figure(*columns).double().item()
    spread = figure(*(column[rows] for column in columns)).double()
    tail = (1 - confidence) / 2
    low, high = spread.nanquantile(torch.tensor([tail, 1 - tail], dtype=torch.float64)).tolist()
    return Estimate(value, low, high)
