"""Poses of the hand drawn on the camera image: the spatial condition of the world model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from worldenv_trl.keys import POSE_DIM
from worldenv_trl.robot import Camera
from worldenv_trl.robot.panda import FINGER_TRAVEL

__all__ = ["ActionMap"]

_NEAR = 0.05  # metres in front of the camera; nothing nearer is drawn
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

    A camera that is mounted on the tool moves with it: its images are taken from where the tool is then, ``tool_pose``,
    which need not be the pose that is drawn.

    Args:
        camera: one :class:`~worldenv_trl.robot.Camera` or several, which ``camera_index`` then chooses from.
        size: image side in pixels, or ``(height, width)``. Pixels are square; ``fovy`` spans the height.

    Keyword Args:
        table_height: z of the table plane (m).
        axis_length: length of the axis segments (m).
        disc_radius: radius of the disc and the drop shadow (m).

    Examples:
        >>> from worldenv_trl.robot import WRIST, look_at
        >>> action_map = ActionMap([look_at("front", (0.8, 0.0, 0.6), (0.0, 0.0, 0.1), 40.0), WRIST], 64)
        >>> poses = torch.zeros(16, 8, 13)
        >>> action_map(poses, torch.zeros(16, 1, dtype=torch.int64)).shape
        torch.Size([16, 8, 6, 64, 64])
    """

    channels = 6
    _position: Tensor  # [cameras, 3]
    _rotation: Tensor  # [cameras, 3, 3]
    _on_tool: Tensor  # [cameras]
    _focal: Tensor  # [cameras], pixels
    _column: Tensor  # [W]
    _row: Tensor  # [H]

    def __init__(
        self,
        camera: Camera | Sequence[Camera],
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

        cameras = [camera] if isinstance(camera, Camera) else list(camera)
        if not cameras:
            raise ValueError("camera is an empty sequence: give at least one Camera")
        positions = [torch.tensor(item.position, dtype=torch.float32) for item in cameras]
        rotations = [torch.tensor(item.rotation, dtype=torch.float32).reshape(3, 3) for item in cameras]
        fovy = torch.tensor([float(item.fovy) for item in cameras]).deg2rad()
        mounted = [item.mount == "tool" for item in cameras]
        self._names = [item.name for item in cameras]
        self._any_on_tool, self._all_on_tool = any(mounted), all(mounted)
        # The cameras belong to the configuration of whoever uses the map: not to its weights.
        self.register_buffer("_position", torch.stack(positions), persistent=False)
        self.register_buffer("_rotation", torch.stack(rotations), persistent=False)
        self.register_buffer("_on_tool", torch.tensor(mounted), persistent=False)
        self.register_buffer("_focal", self.height / 2 / torch.tan(fovy / 2), persistent=False)
        self.register_buffer("_column", torch.arange(self.width, dtype=torch.float32) + 0.5, persistent=False)
        self.register_buffer("_row", torch.arange(self.height, dtype=torch.float32) + 0.5, persistent=False)

    def _camera_index(self, batch: torch.Size, camera_index: Tensor | None) -> Tensor:
        """Row of the camera buffers for every element of ``batch``: [*B]."""
        count = len(self._position)
        if camera_index is None:
            if count > 1:
                raise ValueError(f"camera_index is needed: this map has {count} cameras, {', '.join(self._names)}")
            return torch.zeros(batch, dtype=torch.int64, device=self._position.device)
        if camera_index.is_floating_point() or camera_index.is_complex() or camera_index.dtype == torch.bool:
            raise ValueError(f"camera_index must be whole numbers, got {camera_index.dtype}")
        index = camera_index.long()
        if index.shape != batch and index.ndim and index.shape[-1] == 1:
            index = index.squeeze(-1)
        if index.shape != batch[: index.ndim]:
            raise ValueError(
                f"camera_index must be {list(batch)}, with a last dimension of 1, or a leading part of it, "
                f"got {list(camera_index.shape)}"
            )
        wrong = (index < 0) | (index >= count)
        if bool(wrong.any()):
            raise ValueError(
                f"camera_index must be in [0, {count}), the cameras of this map, got {int(index[wrong][0])}"
            )
        index = index.to(self._position.device)  # checked where it was: what comes from a CPU stops no GPU
        return index.reshape(*index.shape, *[1] * (len(batch) - index.ndim)).expand(batch)

    def _views(self, index: Tensor, tool_pose: Tensor | None) -> tuple[Tensor, Tensor]:
        """Where the cameras [n] of ``index`` are: positions [n, 3] and rotations [n, 3, 3], world from camera."""
        position, rotation = self._position[index], self._rotation[index]
        if not self._any_on_tool:
            return position, rotation
        on_tool = self._on_tool[index]
        if tool_pose is None:
            if self._all_on_tool or bool(on_tool.any()):
                moving = [name for name, moves in zip(self._names, self._on_tool.tolist(), strict=True) if moves]
                raise ValueError(
                    f"tool_pose is needed, as the camera {' and '.join(moving)} is mounted on the tool: pass where the "
                    "tool is when the picture is taken"
                )
            return position, rotation
        tool = tool_pose[:, 3:12].reshape(-1, 3, 3)
        moved = tool_pose[:, :3] + torch.einsum("nij,nj->ni", tool, position)
        on_tool = on_tool.unsqueeze(-1)
        return torch.where(on_tool, moved, position), torch.where(on_tool.unsqueeze(-1), tool @ rotation, rotation)

    def _tool_poses(self, batch: torch.Size, tool_pose: Tensor | None) -> Tensor | None:
        """``tool_pose`` as [n, 13] for the flattened ``batch``; None where no camera moves."""
        if tool_pose is None or not self._any_on_tool:
            return None
        if tool_pose.shape[-1] != POSE_DIM:
            raise ValueError(f"tool_pose must be [*B, 13] (position, rotation, opening), got {list(tool_pose.shape)}")
        try:
            return tool_pose.float().expand(*batch, POSE_DIM).reshape(-1, POSE_DIM)
        except RuntimeError:
            raise ValueError(f"tool_pose must broadcast to {[*batch, 13]}, got {list(tool_pose.shape)}") from None

    def _project(self, points: Tensor, index: Tensor, tool_pose: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Pixels [n, P, 2], depths [n, P] and pixels per metre [n, P] of points [n, P, 3] seen by cameras [n]."""
        position, rotation = self._views(index, tool_pose)
        local = torch.einsum("...pi,...ij->...pj", points - position.unsqueeze(-2), rotation)
        depth = -local[..., 2]
        scale = self._focal[index].unsqueeze(-1) / depth.clamp(min=_NEAR)
        u = self.width / 2 + scale * local[..., 0]
        v = self.height / 2 - scale * local[..., 1]
        return torch.stack([u, v], -1), depth, scale

    def project(self, points: Tensor, camera_index: Tensor | None = None, tool_pose: Tensor | None = None) -> Tensor:
        """Where points are in the image.

        Args:
            points: [*B, 3] in the world (m). Less than 5 cm in front of the camera they are projected as if there.
            camera_index, tool_pose: see :meth:`forward`.

        Returns:
            Pixel coordinates [*B, 2]: u right, v down; the centre of the upper left pixel is (0.5, 0.5).

        Raises:
            ValueError: as :meth:`forward`.
        """
        batch = points.shape[:-1]
        index = self._camera_index(batch, camera_index).reshape(-1)
        pixels = self._project(points.reshape(-1, 1, 3), index, self._tool_poses(batch, tool_pose))[0]
        return pixels.reshape(*batch, 2)

    def forward(self, pose: Tensor, camera_index: Tensor | None = None, tool_pose: Tensor | None = None) -> Tensor:
        """Draw poses.

        Args:
            pose: [*B, 13]: position (m), rotation (row-major 3x3, world from tool), opening in [0, 1].
            camera_index: which of the cameras looks, integer [*B], [*B, 1] or leading part of it ([b, 1] for poses
                [b, C, 13]); needed when there are several.
            tool_pose: where the tool is when the picture is taken, [*B, 13] or what broadcasts to it; needed when a
                camera that looks is mounted on the tool.

        Returns:
            Float maps [*B, 6, H, W] in [0, 1].

        Raises:
            ValueError: wrong shapes, an index that is missing or out of range, a missing tool pose.
        """
        if pose.shape[-1] != POSE_DIM:
            raise ValueError(f"pose must be [*B, 13] (position, rotation, opening), got {tuple(pose.shape)}")
        batch = pose.shape[:-1]
        index = self._camera_index(batch, camera_index).reshape(-1)
        tool = self._tool_poses(batch, tool_pose)
        pose = pose.reshape(-1, POSE_DIM).float()
        if pose.shape[0] == 0:
            return pose.new_zeros(*batch, self.channels, self.height, self.width)
        inputs = [pose] if tool is None else [pose, tool]
        if pose.device.type != "cpu" or (any(item.requires_grad for item in inputs) and torch.is_grad_enabled()):
            maps = self._draw(pose, index, tool)
        else:
            maps = pose.new_empty(pose.shape[0], self.channels, self.height, self.width)
            for first in range(0, pose.shape[0], _ROWS_PER_CHUNK):
                part = slice(first, first + _ROWS_PER_CHUNK)
                maps[part] = self._draw(pose[part], index[part], None if tool is None else tool[part])
        return maps.reshape(*batch, self.channels, self.height, self.width)

    def rays(self, tool_pose: Tensor, size: tuple[int, int], camera_index: Tensor | None = None) -> Tensor:
        """Where every cell of a grid over the image looks from, and to: [*B, 6, h, w].

        Args:
            tool_pose: where the tool is when the picture is taken, [*B, 13].
            size: rows and columns of the grid, which need not be square; the image is.
            camera_index: as in :meth:`forward`.

        Returns:
            World coordinates of the camera's centre (m) and the unit vector through each cell's centre.
        """
        batch = tool_pose.shape[:-1]
        index = self._camera_index(batch, camera_index).reshape(-1)
        position, rotation = self._views(index, self._tool_poses(batch, tool_pose))
        device = position.device
        down, across = ((torch.arange(count, device=device) + 0.5) * (2 / count) - 1 for count in size)
        tangent = (self.height / 2 / self._focal[index]).view(-1, 1, 1)
        x, y = torch.broadcast_tensors(tangent * across, -tangent * down.unsqueeze(-1))  # [n, h, w]
        local = torch.nn.functional.normalize(torch.stack([x, y, -torch.ones_like(x)], 1), dim=1)
        direction = torch.einsum("nij,njhw->nihw", rotation, local)
        origin = position[..., None, None].expand_as(direction)
        return torch.cat([origin, direction], 1).reshape(*batch, 6, *size)

    def _draw(self, pose: Tensor, index: Tensor, tool_pose: Tensor | None) -> Tensor:
        position, rotation, opening = pose[:, :3], pose[:, 3:12].reshape(-1, 3, 3), pose[:, 12].clamp(0, 1)
        tool_axes = rotation.transpose(-1, -2)  # [n, axis, 3]: the columns of R
        ends = position.unsqueeze(1) + self.axis_length * tool_axes
        reach = (FINGER_TRAVEL * opening).unsqueeze(-1) * tool_axes[:, 1]
        table = torch.cat([position[:, :2], torch.full_like(position[:, :1], self.table_height)], -1)
        points = torch.stack([position, *ends.unbind(1), position + reach, position - reach, table], 1)
        pixels, depth, metre = self._project(points, index, tool_pose)  # [n, 7, 2], [n, 7], [n, 7]
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


def _coverage(square_distance: Tensor, radius: Tensor) -> Tensor:
    """Antialiased coverage of a pixel at this squared distance from the centre (line) of a disc (stroke) of ``radius``.

    ``radius - d`` is linearised at the edge, where alone it matters: no square root, and a gradient at d = 0.
    """
    radius = radius[..., None, None]
    return (0.5 + radius / 2 - square_distance / (2 * radius)).clamp(0, 1)
