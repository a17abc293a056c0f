"""Batches that are shared out evenly: as many rows of each task, or of each task and outcome."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["drawn", "share"]


def drawn(pools: Sequence[Tensor], count: int) -> Tensor:
    """About ``count`` rows of pools [n, ...] of rows, with replacement, :func:`share` of each, pool after pool."""
    return torch.cat([pool[torch.randint(len(pool), (share(pools, count),))] for pool in pools])


def share(pools: Sequence[Tensor], count: int) -> int:
    """Rows of each pool among about ``count``: at least one, so more than ``count`` in all where pools are many."""
    return max(1, count // len(pools))
