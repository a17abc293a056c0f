"""The spec of an image entry, without an array of its bounds."""

from __future__ import annotations

import abc
from typing import Any

import torch
from torchrl.data import TensorSpec, Unbounded, UnboundedDiscrete
from torchrl.data.tensor_specs import ContinuousBox

__all__ = ["Pixels"]


class _PixelsMeta(type(UnboundedDiscrete)):  # type: ignore[misc] # TorchRL's turns every instance into its own class
    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        return abc.ABCMeta.__call__(cls, *args, **kwargs)


class Pixels(UnboundedDiscrete, metaclass=_PixelsMeta):
    """uint8 entries with values 0 to 255, as ``UnboundedDiscrete(shape, dtype=torch.uint8)``.

    TorchRL's specs hold the lowest and highest value of every pixel of every row, and make both anew whenever an env's
    spec is read through a transform: for the frames of 192 imagined rollouts at 128 px, two cameras, that took a
    gigabyte and half a minute. Here they are views of one number.

    Args:
        shape: of the entry, batch dimensions included.
        device: of the entry.

    Examples:
        >>> spec = Pixels((2, 3, 64, 64))
        >>> spec.is_in(spec.rand()), spec == UnboundedDiscrete((2, 3, 64, 64), dtype=torch.uint8)
        (True, True)
    """

    def __init__(self, shape: Any, device: Any = None, dtype: torch.dtype = torch.uint8) -> None:
        if dtype != torch.uint8:
            raise ValueError(f"pixels are torch.uint8, got dtype={dtype}: use torchrl's Unbounded for anything else")
        size, device = torch.Size(shape), torch.device("cpu" if device is None else device)
        seen = [max(length, 1) for length in size]  # a size of -1 is not known yet
        low, high = (torch.tensor(value, dtype=dtype, device=device) for value in (0, 255))
        space = ContinuousBox(low, high)
        space.low, space.high = low.expand(seen), high.expand(seen)  # the box would have copied these
        TensorSpec.__init__(self, size, space, device, dtype, "discrete")
        self.encode = self._encode_eager

    def to(self, dest: torch.dtype | Any) -> Unbounded:
        if isinstance(dest, torch.dtype):
            return self if dest == self.dtype else Unbounded(self.shape, self.device, dest)
        return self if dest is None else Pixels(self.shape, dest)
