"""Level planes seen by a camera that stands still: where its pixels' rays meet them, and what it sees there."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from worldenv_trl.robot import Camera

__all__ = ["plane", "warped"]

_LEVEL = 0.05  # of a ray's unit depth: one that falls less meets the plane far away, or behind the camera


def plane(camera: Camera, size: Sequence[int], height: Tensor) -> Tensor:
    """Where the rays of an image's pixels, ``size`` (H, W), meet level planes at ``height`` [n] (m): [n, H, W, 3]."""
    (rows, columns), device = size, height.device
    position, rotation, focal = _pose(camera, rows, device)
    side_down = torch.arange(rows, device=device) + 0.5 - rows / 2
    side_right = torch.arange(columns, device=device) + 0.5 - columns / 2
    down, right = torch.meshgrid(side_down, side_right, indexing="ij")
    rays = torch.stack([right / focal, -down / focal, -torch.ones_like(down)], -1) @ rotation.T  # [H, W, 3]
    far = (height[:, None, None, None] - position[2]) / rays[..., 2:].clamp(max=-_LEVEL)
    return position + far * rays


def warped(images: Tensor, camera: Camera, points: Tensor) -> Tensor:
    """Images uint8 [n, 3, H, W] whose pixels show what ``camera`` sees at ``points`` [n, H, W, 3] (m)."""
    rows, columns = images.shape[-2:]
    position, rotation, focal = _pose(camera, rows, images.device)
    local = (points - position) @ rotation
    scale = focal / -local[..., 2:]
    grid = local[..., :2] * scale * local.new_tensor([2 / columns, -2 / rows])
    return F.grid_sample(images.float(), grid, padding_mode="border", align_corners=False).round().to(images.dtype)


def _pose(camera: Camera, rows: int, device: torch.device) -> tuple[Tensor, Tensor, float]:
    position = torch.tensor(camera.position, dtype=torch.float32, device=device)
    rotation = torch.tensor(camera.rotation, dtype=torch.float32, device=device)
    return position, rotation, float(camera.intrinsics(rows)[0, 0])
