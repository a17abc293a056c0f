"""What the processes that draw for one pool share: poses to draw, and where the images go."""

from __future__ import annotations

import json
import mmap
import struct
from dataclasses import asdict, dataclass

import numpy as np

# Work and results are records of one size, a power of two: pipes then hand each to exactly one reader, and whole.
RECORD = struct.Struct("=III4x")  # number of the drawing, first row, number of rows


@dataclass(frozen=True)
class Layout:
    """Where in the shared file a drawing's part begins, and what is in it (bytes, except ``image_size``: px)."""

    start: int
    num_rows: int
    nq: int
    nmocap: int
    cameras: tuple[str, ...]
    image_size: int
    model_size: int
    glows: tuple[tuple, ...]

    @property
    def size(self) -> int:
        """Bytes, up to where the next part may begin."""
        images = self.num_rows * len(self.cameras) * 3 * self.image_size**2
        used = 8 * self.num_rows * self._width + images + self.model_size
        return -(-used // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY

    @property
    def _width(self) -> int:
        return self.nq + 7 * self.nmocap

    def to_line(self) -> bytes:
        return json.dumps(asdict(self)).encode() + b"\n"

    @staticmethod
    def from_line(line: bytes) -> Layout:
        return Layout(**json.loads(line))


class SharedRows:
    """A drawing's part of the shared file ``file`` (a descriptor), as arrays.

    ``images`` holds ``[num_rows, 3, H, W]`` uint8 for each camera, ``model`` the model as MuJoCo's binary.
    """

    def __init__(self, file: int, layout: Layout) -> None:
        memory = mmap.mmap(file, layout.size, offset=layout.start)
        rows, width, side = layout.num_rows, layout._width, layout.image_size
        poses = np.frombuffer(memory, np.float64, rows * width).reshape(rows, width)
        split = layout.nq + 3 * layout.nmocap
        self._qpos = poses[:, : layout.nq]
        self._mocap_pos = poses[:, layout.nq : split].reshape(rows, layout.nmocap, 3)
        self._mocap_quat = poses[:, split:].reshape(rows, layout.nmocap, 4)
        each, start = rows * 3 * side**2, poses.nbytes
        self.images = []
        for _ in layout.cameras:
            self.images.append(np.frombuffer(memory, np.uint8, each, start).reshape(rows, 3, side, side))
            start += each
        self.model = np.frombuffer(memory, np.uint8, layout.model_size, start)

    def pose(self, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``qpos [nq]``, ``mocap_pos [nmocap, 3]``, ``mocap_quat [nmocap, 4]``: views, to read and to write."""
        return self._qpos[row], self._mocap_pos[row], self._mocap_quat[row]
