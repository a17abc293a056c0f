"""Whether probabilities mean what they say."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["calibration_slope", "expected_calibration_error"]


def expected_calibration_error(probability: Tensor, label: Tensor, bins: int = 10) -> Tensor:
    """Mean distance of what is promised and what comes, in bins of equal width (Naeini et al., AAAI 2015; Guo et al.,
    ICML 2017).

    Args:
        probability: ``[*B, n]`` in [0, 1].
        label: bool ``[*B, n]``.
        bins: of [0, 1], at least 1; each is open below, and the first holds 0.

    Returns:
        float64 ``[*B]``: over bins, the share of the n in it times the distance of their mean probability and the share
        of them that are true. 0 is calibrated.

    Raises:
        ValueError: if the two differ in shape or are empty, a probability is outside [0, 1], or for no bin.

    Examples:
        >>> expected_calibration_error(torch.tensor([0.9, 0.9, 0.9, 0.9]), torch.tensor([True, True, False, False]))
        tensor(0.4000, dtype=torch.float64)
    """
    _check(probability, label)
    if bins < 1:
        raise ValueError(f"bins must be at least 1, got {bins}")
    if not bool(((probability >= 0) & (probability <= 1)).all()):
        raise ValueError("probabilities must lie in [0, 1]")
    place = (probability * bins).ceil().long().clamp(1, bins) - 1
    excess = probability.double() - label.double()
    gaps = torch.zeros(*probability.shape[:-1], bins, dtype=torch.float64, device=probability.device)
    return gaps.scatter_add(-1, place, excess).abs().sum(-1) / probability.shape[-1]


def calibration_slope(probability: Tensor, label: Tensor) -> Tensor:
    """Slope of the least-squares line of outcomes on probabilities: ``[*B, n]`` each -> float64 ``[*B]``.

    1 where a difference in probability is worth what it says, less where it promises too much; NaN where all
    probabilities are equal.

    Raises:
        ValueError: if the two differ in shape or are empty.
    """
    _check(probability, label)
    x, y = probability.double(), label.double()
    x, y = x - x.mean(-1, keepdim=True), y - y.mean(-1, keepdim=True)
    spread = x.square().sum(-1)
    return torch.where(spread > 1e-12 * x.shape[-1], (x * y).sum(-1) / spread, torch.nan)


def _check(probability: Tensor, label: Tensor) -> None:
    if probability.shape != label.shape or probability.ndim < 1 or not probability.shape[-1]:
        raise ValueError(
            f"probability and label must both be [*B, n], n >= 1, got {list(probability.shape)} and {list(label.shape)}"
        )
