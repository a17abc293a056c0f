"""Fidelity of generated frames."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def psnr(generated: Tensor, real: Tensor) -> Tensor:
    """Peak signal-to-noise ratio (dB) of each image.

    Args:
        generated, real: uint8, or floats in [0, 255], ``[*B, 3, H, W]``.

    Returns:
        ``[*B]``; equal images give infinity.

    Raises:
        ValueError: if the shapes differ.
    """
    error = _squared_error(generated, real).mean((-3, -2, -1))
    return 10 * torch.log10(255.0**2 / error)


def moving_pixel_psnr(generated: Tensor, real: Tensor, first: Tensor, threshold: float = 25.0) -> Tensor:
    """PSNR (dB) of each image on the pixels where ``real`` differs from the ``first`` frame; NaN where none does.

    Args:
        generated, real, first: ``[*B, 3, H, W]``.
        threshold: largest difference over the channels, out of 255, above which a pixel has moved.
    """
    moved = ((real.float() - first.float()).abs().amax(-3, keepdim=True) > threshold).expand_as(real)
    error = (_squared_error(generated, real) * moved).sum((-3, -2, -1)) / moved.sum((-3, -2, -1))
    return 10 * torch.log10(255.0**2 / error)


def ssim(generated: Tensor, real: Tensor) -> Tensor:
    """Structural similarity of each image (Wang et al., IEEE TIP 2004): Gaussian window of 11 px, sigma 1.5.

    Args:
        generated, real: ``[*B, 3, H, W]``, at least 11 px high and wide.

    Returns:
        ``[*B]``, 1 for equal images.
    """
    if generated.shape != real.shape:
        raise ValueError(f"images must have the same shape, got {list(generated.shape)} and {list(real.shape)}")
    if min(real.shape[-2:]) < 11:
        raise ValueError(f"ssim needs images of at least 11 px, got {list(real.shape[-2:])}")
    x, y = (image.reshape(-1, 1, *image.shape[-2:]).double() for image in (generated, real))
    offset = torch.arange(11, dtype=torch.float64, device=real.device) - 5
    line = torch.exp(-(offset**2) / (2 * 1.5**2))
    window = torch.outer(line, line)[None, None] / line.sum() ** 2
    mean_x, mean_y, xx, yy, xy = (F.conv2d(image, window) for image in (x, y, x * x, y * y, x * y))
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    contrast = (2 * (xy - mean_x * mean_y) + c2) / (xx - mean_x**2 + yy - mean_y**2 + c2)
    return (luminance * contrast).mean((-3, -2, -1)).reshape(*real.shape[:-3], -1).mean(-1)


def _squared_error(generated: Tensor, real: Tensor) -> Tensor:
    if generated.shape != real.shape:
        raise ValueError(f"images must have the same shape, got {list(generated.shape)} and {list(real.shape)}")
    return (generated.double() - real.double()).square()
