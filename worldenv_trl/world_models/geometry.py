"""Where things are on the image, for the video world model: the tool's surroundings, and the plane of the hand."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["hand_plane", "tool_coordinates"]

_HAND_CENTRE = (0.0, -0.10)  # metres along the tool's y and z axes from the tool centre
_HAND_HALF_SIZE = (0.14, 0.16)
_REACH = 0.05  # metres; how far along an axis its direction on the image is measured


def tool_coordinates(pixels: Tensor, side: int) -> Tensor:
    """Every cell's offset from the tool, saturating far and, once more, near it: [*B, 2] -> [*B, 4, side, side]."""
    axis = torch.arange(side, device=pixels.device, dtype=torch.float32) + 0.5
    offset = (axis - pixels.unsqueeze(-1)) / side  # [*B, 2, side]
    offset = torch.cat([torch.tanh(3 * offset), torch.tanh(12 * offset)], -2)
    across = offset[..., ::2, None, :].expand(*pixels.shape[:-1], 2, side, side)
    down = offset[..., 1::2, :, None].expand(*pixels.shape[:-1], 2, side, side)
    return torch.cat([across, down], -3)


@torch.no_grad()
def hand_plane(poses: Tensor, project: Callable[[Tensor], Tensor], side: int) -> Tensor:
    """Image coordinates -> coordinates on the plane of the tool's y and z axes (affine): [B, C, 2, 3].

    Args:
        poses: [B, C, 13].
        project: world points [B, C, 3] -> image [B, C, 2], ``side`` wide.
        side: width of the image that ``project`` speaks of.
    """
    origin = project(poses[..., :3])
    axes = poses[..., 3:12].unflatten(-1, (3, 3)).mT[..., 1:, :]  # [B, C, axis y or z, 3]
    ends = torch.stack([project(poses[..., :3] + _REACH * axes[..., i, :]) for i in (0, 1)], -1)
    # Image coordinates in [-1, 1] per metre along y and z: [B, C, 2, 2].
    jacobian = (ends - origin.unsqueeze(-1)) * (2 / side / _REACH)
    (a, b), (c, d) = (row.unbind(-1) for row in jacobian.unbind(-2))
    # A plane seen edge-on would be sampled infinitely wide.
    det = a * d - b * c
    least = 0.1 * (b.square() + d.square()) + 1e-2
    det = torch.where(det < 0, -1.0, 1.0) * det.abs().clamp(min=least)
    inverse = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2) / det[..., None, None]
    half = inverse.new_tensor(_HAND_HALF_SIZE).unsqueeze(-1)
    matrix = inverse / half
    centre = origin * (2 / side) - 1
    offset = -(matrix @ centre.unsqueeze(-1)) - inverse.new_tensor(_HAND_CENTRE).unsqueeze(-1) / half
    return torch.cat([matrix, offset], -1)
