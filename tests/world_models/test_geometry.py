from __future__ import annotations

import torch
from small_models import DOWN, FRONT

from worldenv_trl.kinematics import ActionMap
from worldenv_trl.world_models.geometry import hand_plane, tool_coordinates

SIDE = 16
MAP = ActionMap(FRONT, SIDE)


def test_tool_coordinates_are_zero_where_the_tool_is_and_grow_to_the_right_and_down():
    coordinates = tool_coordinates(torch.tensor([5.5, 9.5]), SIDE)
    assert coordinates.shape == (4, SIDE, SIDE)
    assert not coordinates[:, 9, 5].any()
    for channel, gain in ((0, 3), (1, 12)):
        for row, column in ((9, 8), (2, 3)):
            across, down = (gain * torch.tensor([(column - 5) / SIDE, (row - 9) / SIDE])).tanh()
            assert torch.allclose(coordinates[channel, row, column], across, atol=1e-6)
            assert torch.allclose(coordinates[2 + channel, row, column], down, atol=1e-6)


def test_the_hand_texture_lies_on_the_plane_of_the_tool_y_and_z_axes():
    """Projected points of that plane map to their own plane coordinates: affinely, so only near the tool exactly."""
    poses = torch.zeros(1, 2, 13)
    poses[..., :3] = torch.tensor([[0.1, -0.05, 0.2], [-0.1, 0.1, 0.1]])
    turn = torch.tensor(0.4)
    yaw = torch.tensor([[turn.cos(), -turn.sin(), 0], [turn.sin(), turn.cos(), 0], [0, 0, 1]])
    poses[..., 3:12] = torch.stack([DOWN, yaw @ DOWN]).flatten(1)
    affine = hand_plane(poses, MAP.project, SIDE)
    axes = poses[..., 3:12].unflatten(-1, (3, 3))
    for y, z in ((0.0, 0.0), (0.03, 0.0), (0.0, -0.03), (-0.02, 0.02)):
        point = poses[..., :3] + y * axes[..., 1] + z * axes[..., 2]
        image = MAP.project(point) * 2 / SIDE - 1
        plane = (affine[..., :2] @ image.unsqueeze(-1)).squeeze(-1) + affine[..., 2]
        expected = torch.tensor([y / 0.14, (z + 0.10) / 0.16])
        assert torch.allclose(plane, expected.expand_as(plane), atol=0.04)


def test_a_hand_seen_edge_on_gives_a_finite_plane():
    # The y axis along the camera's view: its projection is a point.
    axis = torch.nn.functional.normalize(torch.tensor([1.2, 0.0, 0.8]), dim=0)
    side = torch.tensor([0.0, 1.0, 0.0])
    poses = torch.zeros(1, 1, 13)
    poses[..., 3:12] = torch.stack([side, axis, torch.linalg.cross(side, axis)], -1).flatten()
    assert hand_plane(poses, MAP.project, SIDE).isfinite().all()
