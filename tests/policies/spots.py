"""Two cameras, and soft white spots where they see a point."""

from __future__ import annotations

import numpy as np
import torch

from worldenv_trl.robot import look_at

FRONT = look_at("agentview", (0.8, 0.1, 0.6), (0.0, 0.0, 0.1), 40.0)
SIDE = look_at("agentview", (0.1, 0.9, 0.5), (0.0, 0.0, 0.0), 50.0)


def spot(camera, point, width, size=64):
    """An image, uint8 [3, size, size], with a spot of that standard deviation (px) where ``camera`` sees ``point``."""
    x, y = camera.project(np.asarray(point, dtype=float), size)
    side = torch.arange(size) + 0.5
    light = torch.exp(-((side[None] - x) ** 2 + (side[:, None] - y) ** 2) / (2 * width**2))
    return (255 * light).round().to(torch.uint8).expand(3, size, size)


def centre(image):
    """Where the light of an image [3, H, W] is: x, y (px)."""
    weight, side = image[0].float(), torch.arange(image.shape[-1]) + 0.5
    return torch.stack([(weight.sum(0) * side).sum(), (weight.sum(1) * side).sum()]) / weight.sum()
