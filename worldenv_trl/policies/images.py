"""Images as a pretrained backbone expects them: rotated, resized, cropped, normalised; on any device, without loops."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

__all__ = ["bilinear_resize", "centre_crop", "lanczos_resize", "prepare_images"]


def prepare_images(
    images: Tensor,
    size_px: int,
    *,
    resize: str = "lanczos",
    rotation: int = 0,
    mirror: bool = False,
    crop_area: float = 1.0,
    mean: Sequence[float] = (0.5, 0.5, 0.5),
    std: Sequence[float] = (0.5, 0.5, 0.5),
) -> Tensor:
    """OpenVLA-OFT's steps in its order, float32 [*B, 3, size_px, size_px].

    Args:
        images: uint8 [*B, 3, H, W].
        size_px: side of the result.

    Keyword Args:
        resize: ``lanczos``, or ``bilinear`` (openpi's, without antialiasing).
        rotation: degrees against the clock, a multiple of 90. LIBERO's raw images need 180.
        mirror: exchange left and right after that. Upright images mirrored are LIBERO's raw ones, whose rows run
            upwards, turned by 180.
        crop_area: share of the area that the centre crop keeps; it is brought back to ``size_px``. 1 crops nothing.
        mean, std: of each channel, of values in [0, 1].

    Raises:
        ValueError: for another rotation, or a share outside (0, 1].

    Examples:
        >>> prepare_images(torch.zeros(2, 3, 64, 64, dtype=torch.uint8), 32, rotation=180, crop_area=0.9).shape
        torch.Size([2, 3, 32, 32])
    """
    if rotation % 90:
        raise ValueError(f"rotation must be a multiple of 90 degrees, got {rotation}")
    if not 0 < crop_area <= 1:
        raise ValueError(f"crop_area must lie in (0, 1], got {crop_area}")
    if rotation % 360:
        images = torch.rot90(images, rotation // 90, (-2, -1))
    if mirror:
        images = images.flip(-1)
    pixels = lanczos_resize(images, size_px) if resize == "lanczos" else 255 * bilinear_resize(images, size_px)
    if crop_area < 1:
        pixels = centre_crop(pixels, crop_area)
    center, spread = (torch.tensor(each, device=pixels.device)[:, None, None] for each in (mean, std))
    return (pixels / 255 - center) / spread


def lanczos_resize(images: Tensor, size_px: int) -> Tensor:
    """Lanczos-3 with antialiasing, as Pillow and TensorFlow do it, rounded to whole levels: float32 in [0, 255].

    Args:
        images: [*B, C, H, W], levels in [0, 255].
        size_px: side of the result, [*B, C, size_px, size_px].
    """
    height, width = images.shape[-2:]
    pixels = images.float()
    if (height, width) == (size_px, size_px):
        return pixels
    # A matrix for each side: two products, on whatever device the images are.
    rows, columns = (torch.from_numpy(_lanczos(side, size_px)).to(images.device) for side in (height, width))
    return (rows @ pixels @ columns.mT).round().clamp(0, 255)


def bilinear_resize(images: Tensor, size_px: int) -> Tensor:
    """Square images resized bilinearly without antialiasing, as SmolVLA and openpi do it.

    Args:
        images: uint8 [*B, C, S, S].
        size_px: side of the result, float32 in [0, 1], [*B, C, size_px, size_px].
    """
    pixels = images.float() / 255
    if images.shape[-1] == size_px:
        return pixels
    resized = torch.nn.functional.interpolate(pixels.flatten(0, -4), (size_px, size_px), mode="bilinear")
    return resized.unflatten(0, images.shape[:-3])


def centre_crop(pixels: Tensor, area: float) -> Tensor:
    """The middle of square images, of that share of the area, brought back to their size bilinearly and rounded.

    As TensorFlow's ``crop_and_resize``: the corners of the crop are sampled exactly, and nothing is antialiased.

    Args:
        pixels: float [*B, C, S, S], levels in [0, 255].
        area: in (0, 1].
    """
    side = pixels.shape[-1]
    matrix = torch.from_numpy(_crop(side, math.sqrt(area))).to(pixels.device)
    return (matrix @ pixels @ matrix.mT).round()


# Arrays, not tensors: what is made on the meta device or under a fake mode must not be met again elsewhere.
@functools.cache
def _lanczos(size_in: int, size_out: int) -> np.ndarray:
    scale = size_in / size_out
    stretch = max(scale, 1.0)  # a wider kernel when the image shrinks: antialiasing
    center = (np.arange(size_out) + 0.5) * scale
    x = (np.arange(size_in) + 0.5 - center[:, None]) / stretch  # [out, in]
    weights = np.where(np.abs(x) < 3, np.sinc(x) * np.sinc(x / 3), 0.0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


@functools.cache
def _crop(size: int, share: float) -> np.ndarray:
    where = (1 - share) / 2 * (size - 1) + np.arange(size) * share
    below = np.floor(where).astype(int).clip(max=size - 2)
    matrix = np.zeros((size, size), np.float32)
    matrix[np.arange(size), below] = 1 - (where - below)
    matrix[np.arange(size), below + 1] = where - below
    return matrix
