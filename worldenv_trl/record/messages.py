"""Foxglove's messages as bytes: what is the same in thousands of them is encoded once."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache

import numpy as np
import torch
from foxglove.messages import Log, LogLevel, PoseInFrame, RawImage, Timestamp
from torch import Tensor

from worldenv_trl.record.protobuf import varint

__all__ = ["LOG", "POSE", "RAW_IMAGE", "hand_poses", "image_head", "images", "log"]

RAW_IMAGE, POSE, LOG = ((s.name, s.data) for s in (k.get_schema() for k in (RawImage, PoseInFrame, Log)))
_SECOND = 1_000_000_000
_POSE = struct.Struct("<12sdsdsd3sdsdsdsd")


def images(pixels: np.ndarray, times_ns: list[int]) -> Iterator[bytes]:
    """``foxglove.RawImage`` messages of uint8 [n, H, W, 3]."""
    head = image_head(*pixels.shape[1:3])
    flat = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
    for row, time in zip(flat, times_ns, strict=True):
        yield b"".join((_timestamp(time), head, row.data))


@cache
def image_head(height: int, width: int) -> bytes:
    """What stands before the pixels, which come last, in the messages of :func:`images`."""
    head = struct.pack("<BIBI", 0x15, width, 0x1D, height) + b'"\x04rgb8' + struct.pack("<BI", 0x2D, 3 * width)
    return head + b":\x06camera2" + varint(3 * height * width)


def hand_poses(states: Tensor, times_ns: list[int]) -> Iterator[bytes]:
    """``foxglove.PoseInFrame`` messages of position, axis-angle and opening [n, 7]."""
    states = states.double()
    angle = states[:, 3:6].norm(dim=-1, keepdim=True)
    axis = states[:, 3:6] / angle.clamp(min=1e-12)
    values = torch.cat([states[:, :3], axis * (angle / 2).sin(), (angle / 2).cos()], -1).tolist()
    for (x, y, z, a, b, c, w), time in zip(values, times_ns, strict=True):
        body = _POSE.pack(
            b"\x12\x05world\x1aC\n\x1b\t", x, b"\x11", y, b"\x19", z, b"\x12$\t", a, b"\x11", b, b"\x19", c, b"!", w
        )
        yield _timestamp(time) + body


def log(text: str, time_ns: int) -> bytes:
    """A ``foxglove.Log`` message."""
    stamp = Timestamp(*divmod(time_ns, _SECOND))
    return Log(timestamp=stamp, level=LogLevel.Info, message=text, name="instruction").encode()


def _timestamp(time_ns: int) -> bytes:
    seconds, nanoseconds = divmod(time_ns, _SECOND)
    body = b"\x08" + varint(seconds) + b"\x10" + varint(nanoseconds)
    return b"\n" + varint(len(body)) + body
