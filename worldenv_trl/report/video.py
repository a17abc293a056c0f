"""Frames as something a browser shows without fetching anything: videos and images as data URIs."""

from __future__ import annotations

import base64
import io

import torch
from torch import Tensor

__all__ = ["image_uri", "side_by_side", "video_uri", "video_webm"]


def side_by_side(*videos: Tensor, gap: int = 2) -> Tensor:
    """Videos uint8 ``[T, 3, H, W]`` next to each other ``[T, 3, H, n W + (n - 1) gap]``, grey in between."""
    parts = []
    for video in videos:
        parts += [video.new_full((*video.shape[:-1], gap), 128), video]
    return torch.cat(parts[1:], -1)


def video_webm(frames: Tensor, *, fps: int = 10, scale: int = 1, quality: int = 30) -> bytes:
    """A VP9 WebM file of frames uint8 ``[T, 3, H, W]``.

    Keyword Args:
        fps: frames a second.
        scale: each pixel becomes ``scale`` x ``scale``; keeps small renders sharp under chroma subsampling.
        quality: constant rate factor, 0 (best) to 63.

    Raises:
        ValueError: for frames of another shape or dtype, or none at all.
        ModuleNotFoundError: without PyAV.
    """
    import av  # only reports and loggers need it

    if frames.ndim != 4 or frames.shape[1] != 3 or not len(frames) or frames.dtype != torch.uint8:
        raise ValueError(f"frames must be uint8 [T, 3, H, W], T >= 1, got {frames.dtype} {list(frames.shape)}")
    frames = frames.repeat_interleave(scale, -1).repeat_interleave(scale, -2)
    frames = torch.nn.functional.pad(frames, (0, frames.shape[-1] % 2, 0, frames.shape[-2] % 2))
    target = io.BytesIO()
    with av.open(target, "w", format="webm") as container:
        stream = container.add_stream("libvpx-vp9", rate=fps)
        stream.height, stream.width = frames.shape[-2:]
        stream.pix_fmt = "yuv420p"
        # A key frame every 8: jumping to a step stays quick. One thread: the machine may be shared. "Real time" is six
        # times faster than "good" and as exact on renders.
        speed = {"deadline": "realtime", "cpu-used": "8", "threads": "1"}
        stream.options = {"crf": str(quality), "b:v": "0", "g": "8"} | speed
        for image in frames.permute(0, 2, 3, 1).contiguous().numpy():
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return target.getvalue()


def video_uri(frames: Tensor, *, fps: int = 10, scale: int = 1, quality: int = 30) -> str:
    """What :func:`video_webm` makes, as a data URI."""
    data = video_webm(frames, fps=fps, scale=scale, quality=quality)
    return f"data:video/webm;base64,{base64.b64encode(data).decode()}"


def image_uri(image: Tensor) -> str:
    """A WebP of an image uint8 ``[3, H, W]``."""
    from PIL import Image

    target = io.BytesIO()
    Image.fromarray(image.permute(1, 2, 0).contiguous().numpy()).save(target, "webp", quality=90, method=4)
    return f"data:image/webp;base64,{base64.b64encode(target.getvalue()).decode()}"
