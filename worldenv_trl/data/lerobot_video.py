"""MP4 files of frames, without loss, and any MP4 back to frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["read_video", "write_video"]


def write_video(path: Path, parts: Iterable[np.ndarray], fps: int) -> None:
    """Frames uint8 [T, H, W, 3], part by part: H.264 in RGB at quantiser 0, which loses nothing."""
    av = _av()
    path.parent.mkdir(parents=True, exist_ok=True)
    stream: Any = None
    with av.open(str(path), "w") as container:
        place = 0
        for frames in parts:
            if stream is None:
                stream = container.add_stream("libx264rgb", rate=fps, options={"qp": "0", "g": "2", "preset": "fast"})
                stream.height, stream.width = frames.shape[1:3]
                stream.pix_fmt = "rgb24"
                stream.time_base = stream.codec_context.time_base = Fraction(1, fps)
            for image in frames:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
                frame.pts, frame.time_base = place, Fraction(1, fps)
                place += 1
                container.mux(stream.encode(frame))
        container.mux(stream.encode())


def read_video(path: Path) -> Iterator[np.ndarray]:
    """The frames of a video, uint8 [H, W, 3], in their order."""
    av = _av()
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise ImportError("videos need av: pip install worldenv_trl[data]") from error
    return av
