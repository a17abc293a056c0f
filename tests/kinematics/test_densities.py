"""Densities over the cells of an image, against sums over the cells."""

from __future__ import annotations

import numpy as np
import torch

from worldenv_trl.kinematics.densities import log_density


def test_a_density_sums_to_one_and_lies_around_its_point():
    points = 4 + 8 * torch.rand(3, 5, 2, generator=torch.Generator().manual_seed(0))
    density = log_density(points, 16, 0.7).exp()
    assert density.shape == (3, 5, 256)
    torch.testing.assert_close(density.sum(-1), torch.ones(3, 5))
    right, down = np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5)
    cells = torch.from_numpy(np.stack([right, down], -1).reshape(256, 2)).float()  # row by row
    torch.testing.assert_close(density @ cells, points, atol=0.02, rtol=0)
    spread = (density.unsqueeze(-1) * (cells - points.unsqueeze(-2)).square()).sum(-2).sqrt()
    torch.testing.assert_close(spread, torch.full_like(spread, 0.7), atol=0.02, rtol=0)


def test_a_point_outside_is_nearest_to_the_edge():
    density = log_density(torch.tensor([-3.0, 2.5]), 8, 1.0).unflatten(0, (8, 8))
    assert divmod(int(density.argmax()), 8) == (2, 0)
