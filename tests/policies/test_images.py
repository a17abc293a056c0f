"""Image preparation against Pillow and against a slow crop."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from PIL import Image

from worldenv_trl.policies.images import bilinear_resize, centre_crop, lanczos_resize, prepare_images


@pytest.mark.parametrize("size", [(256, 224), (64, 224), (100, 48)])
def test_resizing_is_pillows(size):
    before, after = size
    # Away from 0 and 255: Pillow clips between its two passes; TensorFlow, which OpenVLA-OFT resizes with, does not.
    pixels = np.random.default_rng(0).integers(100, 156, (before, before, 3), dtype=np.uint8)
    theirs = np.asarray(Image.fromarray(pixels).resize((after, after), Image.Resampling.LANCZOS)).astype(np.float32)
    ours = lanczos_resize(torch.tensor(pixels).permute(2, 0, 1), after).permute(1, 2, 0).numpy()
    assert np.abs(ours - theirs).max() <= 1  # it rounds after each pass


def test_an_image_of_the_right_size_stays_as_it_is():
    image = torch.randint(0, 256, (3, 28, 28), dtype=torch.uint8)
    assert torch.equal(lanczos_resize(image, 28), image.float())


def test_the_crop_samples_the_middle_corner_to_corner():
    side, area = 20, 0.9
    pixels = torch.rand(2, 3, side, side, generator=torch.Generator().manual_seed(0)) * 255
    cropped = centre_crop(pixels, area)
    share = math.sqrt(area)
    first = (1 - share) / 2 * (side - 1)
    for row in (0, 7, 19):
        for column in (0, 12, 19):
            y, x = first + row * share, first + column * share
            below, left = int(y), int(x)
            v, h = y - below, x - left
            corners = pixels[:, :, below : below + 2, left : left + 2]
            expected = (
                corners[..., 0, 0] * (1 - v) * (1 - h)
                + corners[..., 0, 1] * (1 - v) * h
                + corners[..., 1, 0] * v * (1 - h)
                + corners[..., 1, 1] * v * h
            )
            assert (cropped[:, :, row, column] - expected).abs().max() <= 0.5001  # rounded to levels


def test_half_a_turn_swaps_both_axes_and_mean_and_deviation_are_each_channels():
    image = torch.arange(3 * 4 * 4, dtype=torch.uint8).reshape(3, 4, 4)
    mean, std = (0.5, 0.25, 0.0), (1.0, 0.5, 0.25)
    out = prepare_images(image, 4, rotation=180, mean=mean, std=std)
    for channel in range(3):
        expected = (image[channel].flip(0, 1) / 255 - mean[channel]) / std[channel]
        torch.testing.assert_close(out[channel], expected)


def test_upright_images_mirrored_are_raw_ones_turned_by_half():
    raw = torch.randint(0, 256, (2, 3, 6, 6), dtype=torch.uint8)  # as a renderer gives them: the last row is up
    upright = raw.flip(-2)
    turned, mirrored = prepare_images(raw, 6, rotation=180), prepare_images(upright, 6, mirror=True)
    assert torch.equal(turned, mirrored) and not torch.equal(turned, prepare_images(upright, 6))


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"rotation": 45}, "multiple of 90 degrees, got 45"), ({"crop_area": 0.0}, r"lie in \(0, 1\], got 0.0")],
)
def test_what_cannot_be_done_to_an_image_is_named(settings, message):
    with pytest.raises(ValueError, match=message):
        prepare_images(torch.zeros(3, 8, 8, dtype=torch.uint8), 8, **settings)


@pytest.mark.parametrize("after", [20, 7, 10])
def test_bilinear_resizing_weighs_the_four_pixels_around_each_new_centre(after):
    side = 10
    image = torch.randint(0, 256, (2, 3, side, side), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    resized = bilinear_resize(image, after)
    assert resized.shape == (2, 3, after, after) and resized.dtype == torch.float32
    padded = np.pad(image[1, 2].numpy() / 255, 1, mode="edge")
    for row, column in ((0, 0), (3, 5), (after - 1, 2)):
        y, x = ((each + 0.5) * side / after + 0.5 for each in (row, column))  # of the padded image's centres
        top, left = int(y), int(x)
        square = padded[top : top + 2, left : left + 2]
        wanted = np.array([1 - (y - top), y - top]) @ square @ np.array([1 - (x - left), x - left])
        assert resized[1, 2, row, column].item() == pytest.approx(wanted, abs=1e-6)
