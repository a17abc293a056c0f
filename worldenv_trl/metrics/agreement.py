"""How far two verdicts on the same rollouts agree."""

from __future__ import annotations

from torch import Tensor

__all__ = ["cohen_kappa", "precision", "recall"]


def precision(predicted: Tensor, actual: Tensor) -> Tensor:
    """Share of what is predicted that is so: bool ``[*B, n]`` each -> float64 ``[*B]``; NaN where nothing is predicted.

    Raises:
        ValueError: if the two differ in shape.
    """
    both, said, _ = _counts(predicted, actual)
    return both / said


def recall(predicted: Tensor, actual: Tensor) -> Tensor:
    """Share of what is so that is predicted: bool ``[*B, n]`` each -> float64 ``[*B]``; NaN where nothing is so.

    Raises:
        ValueError: if the two differ in shape.
    """
    both, _, true = _counts(predicted, actual)
    return both / true


def cohen_kappa(predicted: Tensor, actual: Tensor) -> Tensor:
    """Agreement beyond chance (Cohen, Educational and Psychological Measurement 1960).

    Args:
        predicted, actual: bool ``[*B, n]``.

    Returns:
        float64 ``[*B]``: 1 where they always agree, 0 where they agree as often as two independent verdicts of the same
        rates would; NaN where both say the same of all, so that chance alone agrees.

    Raises:
        ValueError: if the two differ in shape.

    Examples:
        >>> import torch
        >>> predicted = torch.tensor([True, True, False, False])
        >>> cohen_kappa(predicted, torch.tensor([True, False, True, False])).item()  # as often as chance
        0.0
    """
    both, said, true = _counts(predicted, actual)
    n = predicted.shape[-1]
    observed = 1 - (said + true - 2 * both) / n
    chance = (said * true + (n - said) * (n - true)) / n**2
    return (observed - chance) / (1 - chance)


def _counts(predicted: Tensor, actual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Both, predicted and actual: float64 ``[*B]`` each."""
    if predicted.shape != actual.shape or predicted.ndim < 1:
        raise ValueError(
            f"predicted and actual must both be [*B, n], got {list(predicted.shape)} and {list(actual.shape)}"
        )
    predicted, actual = predicted.bool(), actual.bool()
    both = (predicted & actual).sum(-1).double()
    return both, predicted.sum(-1).double(), actual.sum(-1).double()
