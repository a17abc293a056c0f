"""Pinhole cameras, fixed in the world or on the arm."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from worldenv_trl.robot.panda import TCP_FROM_HAND

__all__ = ["WRIST", "Camera", "look_at"]


@dataclass(frozen=True)
class Camera:
    """MuJoCo's camera: looks along its -z axis, +y is up in the image.

    ``position`` (m) and ``rotation`` (row-major nested tuples) place it in the frame it is mounted on: the ``world``
    (rotation: world from camera), or the ``tool``, whose origin is the tool centre between the fingertips. ``fovy`` is
    the vertical field of view in degrees.

    Raises:
        ValueError: for a ``mount`` other than these two.
    """

    name: str
    position: tuple[float, float, float]
    rotation: tuple[tuple[float, float, float], ...]
    fovy: float
    mount: str = "world"

    def __post_init__(self) -> None:
        if self.mount not in ("world", "tool"):
            raise ValueError(f"mount must be 'world' or 'tool', got {self.mount!r}")
        # A camera read from JSON, where tuples are lists, is the one that was written.
        object.__setattr__(self, "position", tuple(float(value) for value in self.position))
        object.__setattr__(self, "rotation", tuple(tuple(float(value) for value in row) for row in self.rotation))

    def intrinsics(self, size_px: int) -> np.ndarray:
        """``[3, 3]`` matrix for a square image; pixel centres lie at half-integers."""
        focal = 0.5 * size_px / math.tan(math.radians(self.fovy) / 2)
        return np.array([[focal, 0, size_px / 2], [0, focal, size_px / 2], [0, 0, 1]])

    def project(self, points: np.ndarray, size_px: int) -> np.ndarray:
        """Points ``[..., 3]`` (m) in the frame of its mount as image coordinates ``[..., 2]`` (x right, y down; px)."""
        local = (np.asarray(points) - np.array(self.position)) @ np.array(self.rotation)
        focal = self.intrinsics(size_px)[0, 0]
        depth = -local[..., 2]
        return np.stack([size_px / 2 + focal * local[..., 0] / depth, size_px / 2 - focal * local[..., 1] / depth], -1)

    @property
    def axes(self) -> tuple[float, ...]:
        """The image's right and up directions in the frame it is mounted on, as MJCF's ``xyaxes``."""
        rotation = np.array(self.rotation)
        return (*rotation[:, 0], *rotation[:, 1])


def look_at(name: str, position: tuple[float, float, float], target: tuple[float, float, float], fovy: float) -> Camera:
    """A camera at ``position`` whose axis passes through ``target``, upright."""
    back = np.subtract(position, target)
    back = back / np.linalg.norm(back)
    right = np.cross((0.0, 0.0, 1.0), back)
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(back, right), back], 1)
    return Camera(name, position, tuple(map(tuple, rotation.tolist())), fovy)


# Where LIBERO's eye-in-hand camera sits: on the palm's edge, 5 cm beside the fingers' plane, and looks along them.
WRIST = Camera(
    "wrist", (0.05, 0.0, -TCP_FROM_HAND), ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)), 75.0, mount="tool"
)
