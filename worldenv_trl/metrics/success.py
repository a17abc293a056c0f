"""Success rates with intervals, and paired comparisons."""

from __future__ import annotations

import math
from statistics import NormalDist

from torch import Tensor


def wilson_interval(successes: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate (Wilson, JASA 1927).

    Args:
        successes: successful episodes, in [0, n].
        n: episodes, at least 1.
        confidence: in (0, 1).

    Returns:
        ``(low, high)`` in [0, 1].

    Raises:
        ValueError: for counts or a confidence out of range.
    """
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"need 0 <= successes <= n and n >= 1, got successes={successes}, n={n}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be in (0, 1), got {confidence}")
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = successes / n
    center = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    return min(rate, max(0.0, center - half)), max(rate, min(1.0, center + half))  # it holds the rate, rounded or not


def paired_test(before: Tensor, after: Tensor) -> dict[str, float]:
    """McNemar's test of two policies on the same episodes.

    Args:
        before, after: bool ``[n]``, success of the same initial states in the same order.

    Returns:
        ``gained`` (failed before, succeed after), ``lost``, ``difference`` of the rates, its normal score ``z``, the
        exact two-sided ``p_value`` (binomial on the discordant pairs), and ``low`` and ``high``, a 95 % interval of
        the difference (Agresti and Min, Statistics in Medicine 2005: "Wald+2").

    Raises:
        ValueError: if the two differ in length or are empty.
    """
    if before.shape != after.shape or before.ndim != 1 or not len(before):
        raise ValueError(
            f"before and after must be [n] of the same episodes, got {list(before.shape)} and {list(after.shape)}"
        )
    before, after = before.bool(), after.bool()
    n = len(before)
    gained, lost = int((~before & after).sum()), int((before & ~after).sum())
    discordant = gained + lost
    tail = sum(math.comb(discordant, k) for k in range(min(gained, lost) + 1))
    p_value = min(1.0, 2 * tail / 2**discordant)
    # Half a pair more of each kind, or ten pairs that agree would leave no doubt.
    centre = (gained - lost) / (n + 2)
    half = 1.96 * math.sqrt(((discordant + 1) / (n + 2) - centre**2) / (n + 2))
    return {
        "gained": float(gained),
        "lost": float(lost),
        "difference": (gained - lost) / n,
        "z": (gained - lost) / math.sqrt(discordant) if discordant else 0.0,
        "p_value": p_value,
        "low": max(-1.0, centre - half),
        "high": min(1.0, centre + half),
    }
