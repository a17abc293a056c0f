from __future__ import annotations

import math

import pytest
import torch

from worldenv_trl.metrics import moving_pixel_psnr, psnr, ssim


def images(*shape, seed=0):
    return torch.randint(256, shape, generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def test_psnr_of_a_known_error():
    real = torch.full((2, 3, 16, 16), 100, dtype=torch.uint8)
    generated = real.clone()
    generated[0] += 5
    generated[1, :, :8] -= 10  # half of the pixels: mean squared error 50
    expected = [20 * math.log10(255 / 5), 10 * math.log10(255**2 / 50)]
    assert psnr(generated, real).tolist() == pytest.approx(expected)
    assert psnr(real, real).isinf().all()


def test_uint8_differences_do_not_wrap():
    black, white = torch.zeros(1, 3, 12, 12, dtype=torch.uint8), torch.full((1, 3, 12, 12), 255, dtype=torch.uint8)
    assert psnr(black, white).item() == pytest.approx(0)


def test_leading_dimensions_are_kept():
    one, other = images(2, 5, 3, 16, 16), images(2, 5, 3, 16, 16, seed=1)
    for metric in (psnr, ssim):
        assert metric(one, other).shape == (2, 5)
        assert metric(one, other)[1, 3].item() == pytest.approx(metric(one[1, 3], other[1, 3]).item())


def test_moving_pixels_are_those_that_left_the_first_frame():
    first = torch.full((1, 3, 16, 16), 50, dtype=torch.uint8)
    real = first.clone()
    real[0, 1, 4:8, 4:8] = 200  # one channel is enough to move a pixel
    real[0, :, 0, 0] = 60  # a change of 10 is not a movement
    still = moving_pixel_psnr(first, real, first)
    assert still.item() == pytest.approx(10 * math.log10(255**2 / (150**2 / 3)))
    noisy_background = real.clone()
    noisy_background[0, :, 12:] += 90
    assert moving_pixel_psnr(noisy_background, real, first).isinf().all()
    assert moving_pixel_psnr(first, first, first).isnan().all()


def slow_ssim(x, y):
    """Wang et al. 2004, one window at a time."""
    line = [math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)]
    window = torch.tensor([[a * b for a in line] for b in line], dtype=torch.float64)
    window /= window.sum()
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    values = []
    for channel in range(3):
        for i in range(x.shape[1] - 10):
            for j in range(x.shape[2] - 10):
                a = x[channel, i : i + 11, j : j + 11].double()
                b = y[channel, i : i + 11, j : j + 11].double()
                ma, mb = (window * a).sum(), (window * b).sum()
                va, vb = (window * (a - ma) ** 2).sum(), (window * (b - mb) ** 2).sum()
                cab = (window * (a - ma) * (b - mb)).sum()
                values.append(((2 * ma * mb + c1) * (2 * cab + c2)) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    return torch.stack(values).mean().item()


def test_ssim_equals_the_formula_window_by_window():
    x = images(3, 14, 15)
    y = (x.double() * 0.7 + 0.3 * images(3, 14, 15, seed=1).double()).to(torch.uint8)
    assert ssim(x, y).item() == pytest.approx(slow_ssim(x, y), abs=1e-9)
    assert ssim(x, x).item() == pytest.approx(1)


def test_images_that_cannot_be_compared_are_refused():
    with pytest.raises(ValueError, match="same shape"):
        psnr(images(3, 16, 16), images(3, 16, 17))
    with pytest.raises(ValueError, match="same shape"):
        ssim(images(3, 16, 16), images(3, 17, 16))
    with pytest.raises(ValueError, match="at least 11 px"):
        ssim(images(3, 8, 16), images(3, 8, 16))
