from __future__ import annotations

import base64
import io

import av
import numpy as np
import pytest
import torch
from PIL import Image

from worldenv_trl.report.video import image_uri, side_by_side, video_uri


@pytest.fixture
def frames():
    out = torch.full((9, 3, 16, 20), 60, dtype=torch.uint8)
    for step in range(9):
        out[step, 0, :, 2 * step : 2 * step + 4] = 220
    return out


def test_the_video_decodes_to_the_frames_it_was_made_of(frames):
    kind, data = video_uri(frames, fps=10, scale=4).split(",")
    assert kind == "data:video/webm;base64"
    with av.open(io.BytesIO(base64.b64decode(data))) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name.startswith("vp9") or "vp9" in stream.codec_context.name
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(shown) == 9 and shown[0].shape == (64, 80, 3)
    small = np.stack(shown)[:, 2::4, 2::4].astype(int)  # inside each enlarged pixel
    assert np.abs(small - frames.permute(0, 2, 3, 1).numpy()).mean() < 8


def test_odd_sizes_are_padded(frames):
    data = video_uri(frames[..., :15, :19]).split(",")[1]
    with av.open(io.BytesIO(base64.b64decode(data))) as container:
        frame = next(container.decode(video=0))
    assert (frame.height, frame.width) == (16, 20)


def test_videos_side_by_side_keep_their_pixels(frames):
    both = side_by_side(frames, 255 - frames, gap=2)
    assert both.shape == (9, 3, 16, 42)
    assert (both[..., :20] == frames).all() and (both[..., 22:] == 255 - frames).all()


def test_an_image_survives(frames):
    data = base64.b64decode(image_uri(frames[3]).split(",")[1])
    shown = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)
    assert np.abs(shown - frames[3].permute(1, 2, 0).numpy()).mean() < 8


@pytest.mark.parametrize("bad", [torch.zeros(3, 16, 16, dtype=torch.uint8), torch.zeros(4, 3, 16, 16)])
def test_what_is_no_video_is_refused(bad):
    with pytest.raises(ValueError, match=r"uint8 \[T, 3, H, W\]"):
        video_uri(bad)
