"""Foxglove's messages as bytes: many of the same size at once."""

from __future__ import annotations

import struct
from functools import cache

import numpy as np
import torch
from foxglove.messages import Log, LogLevel, PoseInFrame, RawImage, Timestamp
from torch import Tensor

from worldenv_trl.record.mcap.protobuf import varint

__all__ = ["LOG", "POSE", "POSE_BYTES", "RAW_IMAGE", "fill_images", "fill_poses", "image_bytes", "image_head", "log"]

RAW_IMAGE, POSE, LOG = ((s.name, s.data) for s in (k.get_schema() for k in (RawImage, PoseInFrame, Log)))
_SECOND = 1_000_000_000
_STAMP = 14  # bytes of a timestamp whose numbers always take five bytes each
_POSE = np.dtype(
    [("head", "S12"), ("x", "<f8")]
    + [item for name in ("y", "z") for item in ((f"{name}_tag", "u1"), (name, "<f8"))]
    + [("turn", "S3"), ("a", "<f8")]
    + [item for name in ("b", "c", "w") for item in ((f"{name}_tag", "u1"), (name, "<f8"))]
)
POSE_BYTES = _STAMP + _POSE.itemsize


def image_bytes(height: int, width: int) -> int:
    """How long a message of :func:`fill_images` is."""
    return _STAMP + len(image_head(height, width)) + 3 * height * width


def fill_images(messages: np.ndarray, values: np.ndarray, times_ns: np.ndarray) -> None:
    """``foxglove.RawImage`` messages uint8 [n, :func:`image_bytes`] of images uint8 [n, 3, H, W]."""
    count, _, height, width = values.shape
    head = image_head(height, width)
    messages[:, :_STAMP] = _stamps(times_ns)
    messages[:, _STAMP : _STAMP + len(head)] = np.frombuffer(head, np.uint8)
    pixels = messages[:, _STAMP + len(head) :].reshape(count, height, width, 3)  # a view: only its last axis is split
    for channel in range(3):  # thrice as fast as one permuted copy
        pixels[..., channel] = values[:, channel]


@cache
def image_head(height: int, width: int) -> bytes:
    """What stands before the pixels, which come last, in the messages of :func:`fill_images`."""
    head = struct.pack("<BIBI", 0x15, width, 0x1D, height) + b'"\x04rgb8' + struct.pack("<BI", 0x2D, 3 * width)
    return head + b":\x06camera2" + varint(3 * height * width)


def fill_poses(messages: np.ndarray, states: Tensor, times_ns: np.ndarray) -> None:
    """``foxglove.PoseInFrame`` messages uint8 [n, POSE_BYTES] of position, axis-angle and opening [n, 7]."""
    states = states.double()
    angle = states[:, 3:6].norm(dim=-1, keepdim=True)
    axis = states[:, 3:6] / angle.clamp(min=1e-12)
    values = torch.cat([states[:, :3], axis * (angle / 2).sin(), (angle / 2).cos()], -1).numpy()
    body = np.empty(len(values), _POSE)
    body["head"], body["turn"] = b"\x12\x05world\x1aC\n\x1b\t", b"\x12$\t"
    for tag, number in (("y", 0x11), ("z", 0x19), ("b", 0x11), ("c", 0x19), ("w", 0x21)):
        body[f"{tag}_tag"] = number
    for name, column in zip(("x", "y", "z", "a", "b", "c", "w"), values.T, strict=True):
        body[name] = column
    messages[:, :_STAMP] = _stamps(times_ns)
    messages[:, _STAMP:] = body.view(np.uint8).reshape(len(values), -1)


def log(text: str, time_ns: int) -> bytes:
    """A ``foxglove.Log`` message."""
    stamp = Timestamp(*divmod(time_ns, _SECOND))
    return Log(timestamp=stamp, level=LogLevel.Info, message=text, name="instruction").encode()


def _stamps(times_ns: np.ndarray) -> np.ndarray:
    """Timestamps uint8 [n, 14]. A varint may be longer than it has to be; so all of them are as long."""
    out = np.empty((len(times_ns), _STAMP), np.uint8)
    out[:, :3], out[:, 8] = np.frombuffer(b"\n\x0c\x08", np.uint8), 0x10
    seconds, nanoseconds = np.divmod(times_ns, _SECOND)
    for first, number in ((3, seconds), (9, nanoseconds)):
        for place in range(5):
            out[:, first + place] = (number >> 7 * place & 0x7F) | (0x80 if place < 4 else 0)
    return out
