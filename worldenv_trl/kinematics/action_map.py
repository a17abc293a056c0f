"""Poses of the hand drawn on the camera image: the spatial condition of the world model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from worldenv_trl.scenes.camera import Camera

__all__ = ["ActionMap"]

_NEAR = 0.05  # metres in front of the camera; nothing nearer is drawn
_FINGER_TRAVEL = 0.04  # metres from the tool centre to a fully open fingertip
_ROWS_PER_CHUNK = 64  # keeps the temporaries of a chunk inside the CPU cache


class ActionMap(nn.Module):
    """Image-plane maps of hand poses (EnerVerse-AC's pose action map; World-Env section 3.2).

    EVAC paints a disc coloured by the gripper's opening and three axis segments of constant pixel size. Its sizes fit a
    512 px image of a large robot and its colour scale a gripper measured in degrees; here every size is metric, so
    that it scales with the image, the arm and the distance from the camera, the opening is a fraction, and each mark
    has its own channel instead of a colour:

    0. a disc at the tool centre, from 0.3 (closed) to 1 (open);
    1. 2. 3. the tool's x, y and z axis, ``axis_length`` long, bright at the tool centre and half as bright at the end;
    4. the two fingertips, apart along the tool's y axis by the opening;
    5. the tool centre dropped vertically on the table: the distance from the disc tells the height.

    All marks are distance fields, antialiased and differentiable in the pose; a hand behind the camera draws nothing.

    Args:
        camera: one :class:`~worldenv_trl.scenes.camera.Camera`, or a mapping from task id to camera; anything with
            ``position``, ``rotation`` (world from camera, looking along -z) and ``fovy`` or ``fovy_deg`` (degrees).
        size: image side in pixels, or ``(height, width)``. Pixels are square; ``fovy`` spans the height.

    Keyword Args:
        table_height: z of the table plane (m).
        axis_length: length of the axis segments (m).
        disc_radius: radius of the disc and the drop shadow (m).

    Examples:
        >>> action_map = ActionMap(camera, 64)  # doctest: +SKIP
        >>> action_map(pose).shape  # pose [16, 8, 13]  # doctest: +SKIP
        torch.Size([16, 8, 6, 64, 64])
    """

    channels = 6

    def __init__(
        self,
        camera: Camera | Mapping[int, Camera],
        size: int | tuple[int, int],
        *,
        table_height: float = 0.0,
        axis_length: float = 0.08,
        disc_radius: float = 0.016,
    ) -> None:
        super().__init__()
        height, width = (size, size) if isinstance(size, int) else size
        if min(height, width) < 16:
            raise ValueError(f"size must be at least 16 px, got {size}")
        self.height, self.width = int(height), int(width)
        self.table_height, self.axis_length, self.disc_radius = table_height, axis_length, disc_radius

        cameras = dict(camera) if isinstance(camera, Mapping) else {0: camera}
        if not cameras:
            raise ValueError("camera is an empty mapping: give at least one task id -> Camera")
        if min(cameras) < 0:
            raise ValueError(f"task ids must not be negative, got {min(cameras)}")
        self._per_task = isinstance(camera, Mapping) and len(cameras) > 1
        ids = sorted(cameras)
        lookup = torch.full((ids[-1] + 1,), -1, dtype=torch.int64)
        lookup[torch.tensor(ids)] = torch.arange(len(ids))
        positions = [torch.as_tensor(cameras[i].position, dtype=torch.float32) for i in ids]
        rotations = [torch.as_tensor(cameras[i].rotation, dtype=torch.float32).reshape(3, 3) for i in ids]
        fovy = torch.tensor([_fovy_deg(cameras[i]) for i in ids]).deg2rad()
        # The cameras belong to the configuration of whoever uses the map: not to its weights.
        self.register_buffer("_lookup", lookup, persistent=False)
        self.register_buffer("_position", torch.stack(positions), persistent=False)
        self.register_buffer("_rotation", torch.stack(rotations), persistent=False)
        self.register_buffer("_focal", self.height / 2 / torch.tan(fovy / 2), persistent=False)
        self.register_buffer("_column", torch.arange(self.width, dtype=torch.float32) + 0.5, persistent=False)
        self.register_buffer("_row", torch.arange(self.height, dtype=torch.float32) + 0.5, persistent=False)

    def _camera_index(self, batch: torch.Size, task_id: Tensor | None) -> Tensor:
        """Row of the camera buffers for every element of ``batch``: [*B]."""
        if task_id is None:
            if self._per_task:
                raise ValueError(f"task_id is needed: this map has {len(self._position)} cameras, one per task")
            return self._lookup.new_zeros(batch)
        ids = task_id.to(self._lookup.device).long()
        if ids.shape != batch and ids.ndim and ids.shape[-1] == 1:
            ids = ids.squeeze(-1)
        ids = ids.reshape(*ids.shape, *[1] * (len(batch) - ids.ndim)).expand(batch)
        if not self._per_task and len(self._lookup) == 1:
            return torch.zeros_like(ids)  # a single camera serves every task
        known = (ids >= 0) & (ids < len(self._lookup))
        index = self._lookup[ids.clamp(0, len(self._lookup) - 1)]
        if not bool((known & (index >= 0)).all()):
            bad = ids[~(known & (index >= 0))][0].item()
            served = (self._lookup >= 0).nonzero().flatten().tolist()
            raise ValueError(f"no camera for task id {bad}; this map has cameras for the task ids {served}")
        return index

    def _project(self, points: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels [*B, P, 2] and depths [*B, P] of world points [*B, P, 3] seen by cameras [*B]."""
        local = torch.einsum("...pi,...ij->...pj", points - self._position[index].unsqueeze(-2), self._rotation[index])
        depth = -local[..., 2]
        scale = self._focal[index].unsqueeze(-1) / depth.clamp(min=_NEAR)
        u = self.width / 2 + scale * local[..., 0]
        v = self.height / 2 - scale * local[..., 1]
        return torch.stack([u, v], -1), depth

    def project(self, points: Tensor, task_id: Tensor | None = None) -> Tensor:
        """Pixel coordinates [*B, 2] (u right, v down; the centre of the upper left pixel is (0.5, 0.5)) of world
        points [*B, 3] in metres. Points less than 5 cm in front of the camera are projected as if they were there."""
        index = self._camera_index(points.shape[:-1], task_id)
        return self._project(points.unsqueeze(-2), index)[0].squeeze(-2)

    def forward(self, pose: Tensor, task_id: Tensor | None = None) -> Tensor:
        """Draw poses.

        Args:
            pose: [*B, 13]: position (m), rotation (row-major 3x3, world from tool), opening in [0, 1].
            task_id: integer [*B], [*B, 1] or leading part of it ([b, 1] for poses [b, C, 13]); needed when the map has
                one camera per task.

        Returns:
            Float maps [*B, 6, H, W] in [0, 1].

        Raises:
            ValueError: wrong last dimension, missing or unknown task id.
        """
        if pose.shape[-1] != 13:
            raise ValueError(f"pose must be [*B, 13] (position, rotation, opening), got {tuple(pose.shape)}")
        batch = pose.shape[:-1]
        index = self._camera_index(batch, task_id).reshape(-1)
        pose = pose.reshape(-1, 13).float()
        if pose.shape[0] == 0:
            return pose.new_zeros(*batch, self.channels, self.height, self.width)
        if pose.device.type != "cpu" or (pose.requires_grad and torch.is_grad_enabled()):
            maps = self._draw(pose, index)
        else:
            maps = pose.new_empty(pose.shape[0], self.channels, self.height, self.width)
            for first in range(0, pose.shape[0], _ROWS_PER_CHUNK):
                part = slice(first, first + _ROWS_PER_CHUNK)
                maps[part] = self._draw(pose[part], index[part])
        return maps.reshape(*batch, self.channels, self.height, self.width)

    def _draw(self, pose: Tensor, index: Tensor) -> Tensor:
        position, rotation, opening = pose[:, :3], pose[:, 3:12].reshape(-1, 3, 3), pose[:, 12].clamp(0, 1)
        tool_axes = rotation.transpose(-1, -2)  # [n, axis, 3]: the columns of R
        ends = position.unsqueeze(1) + self.axis_length * tool_axes
        reach = (_FINGER_TRAVEL * opening).unsqueeze(-1) * tool_axes[:, 1]
        table = torch.cat([position[:, :2], torch.full_like(position[:, :1], self.table_height)], -1)
        points = torch.stack([position, *ends.unbind(1), position + reach, position - reach, table], 1)
        pixels, depth = self._project(points, index)  # [n, 7, 2], [n, 7]
        metre = self._focal[index].unsqueeze(-1) / depth.clamp(min=_NEAR)  # pixels per metre at every point
        visible = (depth > _NEAR).float()
        disc = (self.disc_radius * metre).clamp(min=1.25)
        finger = (0.5 * self.disc_radius * metre).clamp(min=1.0)
        thickness = (0.2 * self.disc_radius * metre).clamp(min=0.75)

        centre, end = pixels[:, :1], pixels[:, 1:4]
        dots = self._discs(pixels[:, [0, 4, 5, 6]], torch.cat([disc[:, :1], finger[:, 4:6], disc[:, 6:]], -1))
        dots = dots * visible[:, [0, 4, 5, 6], None, None]
        lines = self._segments(centre, end, thickness[:, :1]) * (visible[:, :1] * visible[:, 1:4])[..., None, None]
        palm = dots[:, :1] * (0.3 + 0.7 * opening)[:, None, None, None]
        tips = torch.maximum(dots[:, 1:2], dots[:, 2:3])
        return torch.cat([palm, lines, tips, dots[:, 3:]], 1)

    def _discs(self, centre: Tensor, radius: Tensor) -> Tensor:
        """Coverage [n, P, H, W] of discs at pixels [n, P, 2] of radius [n, P]."""
        across = (self._column - centre[..., :1]).square().unsqueeze(-2)
        down = (self._row - centre[..., 1:]).square().unsqueeze(-1)
        return _coverage(across + down, radius)

    def _segments(self, start: Tensor, end: Tensor, half_width: Tensor) -> Tensor:
        """Coverage [n, P, H, W] of segments between pixels [n, 1, 2] and [n, P, 2], fading to one half at the end."""
        direction = end - start
        length = direction.square().sum(-1).clamp(min=1e-6)[..., None, None]
        x, y = self._column - start[..., :1], self._row - start[..., 1:]  # [n, 1, W], [n, 1, H]
        along = (x * direction[..., :1]).unsqueeze(-2) + (y * direction[..., 1:]).unsqueeze(-1)
        fraction = (along / length).clamp(0, 1)
        square = x.square().unsqueeze(-2) + y.square().unsqueeze(-1)  # [n, 1, H, W]
        # |p - t d|^2 with t the clamped foot of the perpendicular.
        distance = square - fraction * (2 * along - fraction * length)
        return _coverage(distance, half_width) * (1 - 0.5 * fraction)


def _fovy_deg(camera: Camera) -> float:
    return float(camera.fovy_deg if hasattr(camera, "fovy_deg") else camera.fovy)


def _coverage(square_distance: Tensor, radius: Tensor) -> Tensor:
    """Antialiased coverage of a pixel at this squared distance from the centre (line) of a disc (stroke) of ``radius``.

    ``radius - d`` is linearised at the edge, where alone it matters: no square root, and a gradient at d = 0.
    """
    radius = radius[..., None, None]
    return (0.5 + radius / 2 - square_distance / (2 * radius)).clamp(0, 1)
