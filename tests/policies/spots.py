"""Two cameras, and soft white spots where they see a point."""

from __future__ import annotations

import numpy as np
import torch

from worldenv_trl.robot import look_at
from worldenv_trl.row_share import row_share

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


def check_shared(shift, samples, entries):
    """Two processes with a half of the samples each make of them what one makes of all."""
    torch.manual_seed(3)
    expected = shift(samples)
    for rank, part in enumerate(samples.chunk(2)):
        torch.manual_seed(3)
        with row_share(rank, 2):
            found = shift(part)
        for entry in entries:
            assert torch.equal(found[entry], expected.chunk(2)[rank][entry])
