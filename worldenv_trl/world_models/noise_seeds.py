"""Where the world model's noise comes from: a hash, not a stream, so that no row depends on another."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["noise_seeds"]


def noise_seeds(seed: int, *parts: Tensor) -> Tensor:
    """Seeds int64 [n] in [0, 2^62): a hash of ``seed`` and the whole numbers in ``parts``, int64 [n] each, in order."""
    mixed = torch.full_like(parts[0], seed)
    for part in parts:
        mixed = _mix(mixed ^ _mix(part + 1))
    return mixed & (2**62 - 1)


def _mix(value: Tensor) -> Tensor:
    """splitmix64 on int64 (wrapping): neighbouring integers become unrelated ones."""
    value = value + -7046029254386353131
    value = (value ^ ((value >> 30) & (2**34 - 1))) * -4658895280553007687
    value = (value ^ ((value >> 27) & (2**37 - 1))) * -7723592293110705685
    return value ^ ((value >> 31) & (2**33 - 1))
