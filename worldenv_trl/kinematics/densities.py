"""Points on an image as densities over its cells: what maps of places are taught."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["log_density"]


def log_density(points: Tensor, side: int, width: float) -> Tensor:
    """Log of normal densities around points, over the cells of a square image, each summing to 1.

    Args:
        points: [*B, 2], right and down, in cells; the centre of the upper left cell is (0.5, 0.5).
        side: cells along either side.
        width: standard deviation, in cells.

    Returns:
        [*B, side * side], row by row.
    """
    cells = torch.arange(side, device=points.device) + 0.5
    right, down = ((cells - each.unsqueeze(-1)).square() for each in points.unbind(-1))  # [*B, side] each
    away = down.unsqueeze(-1) + right.unsqueeze(-2)
    return (-away / (2 * width**2)).flatten(-2).log_softmax(-1)
