"""Images as cells, the layout of the network's finest grid: nothing is reordered between network, painter and loss."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["from_cells", "to_cells", "to_float", "to_uint8"]


def to_cells(images: Tensor, patch: int) -> Tensor:
    """[*B, H, W] -> [*B, patch^2, H / patch, W / patch]: the pixels of a cell side by side, row by row."""
    cells = images.unflatten(-1, (-1, patch)).unflatten(-3, (-1, patch))  # [*B, h, p, w, p]
    return cells.movedim((-3, -1), (-4, -3)).contiguous().flatten(-4, -3)


def from_cells(cells: Tensor, patch: int) -> Tensor:
    """[*B, patch^2, h, w] -> [*B, h * patch, w * patch], the inverse of :func:`to_cells`."""
    images = cells.unflatten(-3, (patch, patch)).movedim((-4, -3), (-3, -1))  # [*B, h, p, w, p]
    return images.contiguous().flatten(-4, -3).flatten(-2, -1)


def to_float(images: Tensor) -> Tensor:
    """uint8 images -> float in [-1, 1]."""
    return images.float() * (2 / 255) - 1


def to_uint8(images: Tensor) -> Tensor:
    """Float images in [-1, 1] -> uint8, rounded."""
    return ((images + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
