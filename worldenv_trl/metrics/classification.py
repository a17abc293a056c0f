"""How well probabilities predict a yes or no."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Classification:
    """Figures of a binary classifier; 0 where nothing was predicted, or true, at all.

    ``auc`` is NaN with one class only.
    """

    precision: float
    recall: float
    f1: float
    auc: float


def classification(probability: Tensor, label: Tensor, threshold: float = 0.5) -> Classification:
    """Precision, recall and F1 at a threshold, and the area under the ROC curve.

    Args:
        probability: ``[n]``.
        label: bool ``[n]``.
        threshold: predicted true above it.

    Raises:
        ValueError: if the two differ in shape or are empty.
    """
    if probability.shape != label.shape or probability.ndim != 1 or not len(label):
        raise ValueError(
            f"probability and label must be [n], n >= 1, got {list(probability.shape)} and {list(label.shape)}"
        )
    label = label.bool()
    predicted = probability > threshold
    hits = int((predicted & label).sum())
    precision = hits / max(int(predicted.sum()), 1)
    recall = hits / max(int(label.sum()), 1)
    f1 = 2 * precision * recall / (precision + recall) if hits else 0.0
    return Classification(precision, recall, f1, _auc(probability, label))


def _auc(probability: Tensor, label: Tensor) -> float:
    """Mann-Whitney's U: the share of (true, false) pairs that are ranked right, ties counted half."""
    _, inverse, counts = probability.double().unique(return_inverse=True, return_counts=True)
    ends = counts.cumsum(0).double()
    ranks = (ends - (counts.double() - 1) / 2)[inverse]
    positive = int(label.sum())
    negative = len(label) - positive
    if not positive or not negative:
        return float("nan")
    return float((ranks[label].sum() - positive * (positive + 1) / 2) / (positive * negative))
