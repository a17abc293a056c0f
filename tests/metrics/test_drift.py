from __future__ import annotations

import math

import pytest
import torch

from worldenv_trl.metrics import drift, moving_pixel_psnr, psnr


@pytest.fixture
def videos():
    torch.manual_seed(0)
    real = torch.randint(0, 256, (5, 7, 3, 16, 16), dtype=torch.uint8)
    return (real.int() + torch.randint(-20, 21, real.shape)).clamp(0, 255).to(torch.uint8), real


def test_the_curves_are_the_means_of_the_psnr_of_each_step(videos):
    imagined, real = videos
    out = drift(imagined, real)
    assert out["horizon"].tolist() == [1, 2, 3, 4, 5, 6] and out["episodes"].tolist() == [5] * 6
    assert out["psnr"][3].item() == pytest.approx(psnr(imagined[:, 4], real[:, 4]).mean().item())
    moved = moving_pixel_psnr(imagined[:, 4], real[:, 4], real[:, 0])
    assert out["moving_psnr"][3].item() == pytest.approx(moved.mean().item())
    assert out["copy_psnr"][3].item() == pytest.approx(psnr(real[:, 0], real[:, 4]).mean().item())
    half = 1.96 * moved.std().item() / math.sqrt(5)
    assert (out["moving_psnr_high"] - out["moving_psnr"])[3].item() == pytest.approx(half)


def test_an_episode_counts_as_long_as_it_lasts(videos):
    imagined, real = videos
    length = torch.tensor([[6], [2], [4], [4], [1]])
    out = drift(imagined, real, length)
    assert out["episodes"].tolist() == [5, 4, 3, 3, 1, 1]
    rows = [0, 2, 3]
    assert out["psnr"][2].item() == pytest.approx(psnr(imagined[rows, 3], real[rows, 3]).mean().item())


def test_equal_videos_stay_finite_and_still_ones_have_no_moving_pixels():
    still = torch.full((2, 4, 3, 16, 16), 7, dtype=torch.uint8)
    out = drift(still, still)
    assert (out["psnr"] == 60).all() and out["moving_psnr"].isnan().all()


def test_videos_of_different_shape_or_without_a_step_are_refused(videos):
    imagined, real = videos
    with pytest.raises(ValueError, match="same shape"):
        drift(imagined[:, :3], real)
    with pytest.raises(ValueError, match="no horizon"):
        drift(imagined[:, :1], real[:, :1])
