"""A hash of whole numbers, for random numbers that are a function of what they belong to and of nothing else."""

from __future__ import annotations

from torch import Tensor

__all__ = ["splitmix64"]


def splitmix64(value: Tensor) -> Tensor:
    """SplitMix64 (Steele, Lea and Flood 2014) on int64, wrapping: neighbouring integers become unrelated ones."""
    value = value + -7046029254386353131
    value = (value ^ ((value >> 30) & (2**34 - 1))) * -4658895280553007687
    value = (value ^ ((value >> 27) & (2**37 - 1))) * -7723592293110705685
    return value ^ ((value >> 31) & (2**33 - 1))
