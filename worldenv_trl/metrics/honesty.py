"""How far success in imagination is success."""

from __future__ import annotations

from torch import Tensor

from worldenv_trl.metrics.classification import classification
from worldenv_trl.metrics.success import paired_test


def honesty(
    imagined: Tensor, real: Tensor, *, imagined_steps: Tensor | None = None, real_steps: Tensor | None = None
) -> dict[str, float]:
    """Compares outcomes of the same contexts in imagination and in the physics.

    Args:
        imagined: bool ``[n]``, success in imagination.
        real: bool ``[n]``, success in the physics.

    Keyword Args:
        imagined_steps, real_steps: ``[n]``, env steps until success; compared where both succeed.

    Returns:
        ``precision``, ``recall`` and ``f1`` of imagined success, ``gap`` of the success rates (imagined minus real)
        with a 95 % interval ``gap_low``, ``gap_high``, and with steps ``stop_error``, the mean absolute difference
        (NaN where nothing succeeds in both).

    Raises:
        ValueError: if the two differ in length or are empty.
    """
    test = paired_test(real, imagined)
    figures = classification(imagined.float(), real)
    report = {
        "precision": figures.precision,
        "recall": figures.recall,
        "f1": figures.f1,
        "gap": test["difference"],
        "gap_low": test["low"],
        "gap_high": test["high"],
    }
    if imagined_steps is not None and real_steps is not None:
        both = imagined.bool() & real.bool()
        difference = (imagined_steps.double() - real_steps.double()).abs()[both]
        report["stop_error"] = difference.mean().item() if len(difference) else float("nan")
    return report
