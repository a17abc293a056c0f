"""Level planes seen by a camera: against the camera's own projection."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worldenv_trl.kinematics.planes import plane, warped
from worldenv_trl.robot.camera import look_at

FRONT = look_at("front", (0.8, 0.1, 0.6), (0.0, 0.0, 0.1), 40.0)


@pytest.mark.parametrize("size", [(16, 16), (12, 20)])
def test_a_point_of_the_plane_is_seen_in_the_pixel_that_it_was_met_by(size):
    heights = torch.tensor([0.0, 0.03, 0.2])
    points = plane(FRONT, size, heights)
    assert points.shape == (3, *size, 3)
    torch.testing.assert_close(points[..., 2], heights[:, None, None].expand(3, *size))
    middle = (size[1] - size[0]) / 2  # the camera's own projection is that of a square image
    column, row = np.meshgrid(np.arange(size[1]) + 0.5 - middle, np.arange(size[0]) + 0.5)
    expected = np.broadcast_to(np.stack([column, row], -1), (3, *size, 2))
    np.testing.assert_allclose(FRONT.project(points.numpy(), size[0]), expected, atol=1e-3)


def test_rays_that_do_not_fall_meet_it_far_away_in_front():
    level = look_at("level", (0.8, 0.0, 0.3), (0.0, 0.0, 0.3), 60.0)
    points = plane(level, (16, 16), torch.tensor([0.0]))[0]
    assert points.isfinite().all() and (points[:8, :, 0] < -4).all()  # above the horizon, or just below it


def test_an_image_seen_where_its_pixels_were_met_is_itself():
    images = torch.randint(256, (2, 3, 16, 16), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    points = plane(FRONT, (16, 16), torch.tensor([0.0, 0.1]))
    assert torch.equal(warped(images, FRONT, points), images)
    beside = points[:, :, [*range(1, 16), 15]]  # each pixel sees what its right neighbour saw
    assert torch.equal(warped(images, FRONT, beside)[..., :15], images[..., 1:])
