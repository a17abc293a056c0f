"""Where the world model's noise comes from: a hash, not a stream, so that no row depends on another."""

from __future__ import annotations

import torch
from torch import Tensor

from worldenv_trl.splitmix import splitmix64

__all__ = ["noise_seeds"]


def noise_seeds(seed: int, *parts: Tensor) -> Tensor:
    """Seeds int64 [n] in [0, 2^62): a hash of ``seed`` and the whole numbers in ``parts``, int64 [n] each, in order."""
    mixed = torch.full_like(parts[0], seed)
    for part in parts:
        mixed = splitmix64(mixed ^ splitmix64(part + 1))
    return mixed & (2**62 - 1)
