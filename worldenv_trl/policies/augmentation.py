"""Image augmentation for imitation from few demonstrations."""

from __future__ import annotations

import torch

from worldenv_trl.row_share import own_rows


def random_shift(images: torch.Tensor, pixels: int = 2, generator: torch.Generator | None = None) -> torch.Tensor:
    """Shifts every image by its own random whole number of pixels; the border repeats the edge (DrQ, arXiv:2004.13649).

    Args:
        images: ``[*B, 3, H, W]``, any dtype.
        pixels: largest shift, up, down, left and right.
        generator: source of the shifts; the global one by default.

    Returns:
        A new tensor of the same shape and dtype.

    Raises:
        ValueError: for a shift below 0, or one that leaves the image.

    Examples:
        >>> random_shift(torch.zeros(2, 8, 3, 64, 64, dtype=torch.uint8), pixels=2).shape
        torch.Size([2, 8, 3, 64, 64])
    """
    if pixels < 0 or pixels >= min(images.shape[-2:]):
        raise ValueError(f"pixels must be in [0, {min(images.shape[-2:]) - 1}], got {pixels}")
    if pixels == 0:
        return images.clone()
    height, width = images.shape[-2:]
    flat = images.reshape(-1, *images.shape[-3:])
    shift = own_rows(
        lambda count: torch.randint(-pixels, pixels + 1, (2, count, 1), generator=generator), flat.shape[0], 1
    ).to(images.device)
    # Clamped indices are the repeated border; gathering keeps uint8 as it is.
    rows = (torch.arange(height, device=images.device) + shift[0]).clamp(0, height - 1)  # [N, H]
    columns = (torch.arange(width, device=images.device) + shift[1]).clamp(0, width - 1)  # [N, W]
    index = (rows[:, :, None] * width + columns[:, None, :]).flatten(1)  # [N, H * W]
    pixels_flat = flat.flatten(2)  # [N, 3, H * W]
    return pixels_flat.gather(2, index[:, None].expand_as(pixels_flat)).reshape(images.shape)
