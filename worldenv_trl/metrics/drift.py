"""How imagination departs from the physics, step by step, under the same actions."""

from __future__ import annotations

import torch
from torch import Tensor

from worldenv_trl.metrics.video import moving_pixel_psnr, psnr

__all__ = ["drift"]

_EQUAL_DB = 60.0  # PSNR of equal images would be infinite, and every mean with it


def drift(imagined: Tensor, real: Tensor, length: Tensor | None = None) -> dict[str, Tensor]:
    """PSNR (dB) against the horizon, on all and on moving pixels, beside showing the first frame for ever.

    Args:
        imagined, real: uint8 ``[R, T + 1, 3, H, W]``, the same first frames and the same actions.
        length: int64 ``[R]`` or ``[R, 1]``, executed steps of each episode; all T by default.

    Returns:
        ``horizon`` int64 ``[T']`` (1 to the longest length), ``episodes`` int64 ``[T']`` (those that last so long), and
        for each of ``psnr``, ``moving_psnr``, ``copy_psnr``, ``copy_moving_psnr``: the mean over episodes ``[T']`` and
        its 95 % interval ``<name>_low``, ``<name>_high``. NaN where no pixel has moved in any episode.

    Raises:
        ValueError: if the videos differ in shape or show nothing after the first frame.
    """
    if imagined.shape != real.shape or imagined.ndim != 5:
        raise ValueError(
            f"videos must be [R, T + 1, 3, H, W] of the same shape, got {list(imagined.shape)} and {list(real.shape)}"
        )
    rows, steps = real.shape[0], real.shape[1] - 1
    length = torch.full((rows,), steps) if length is None else torch.as_tensor(length).reshape(rows)
    if not rows or int(length.max()) < 1:
        raise ValueError(f"{rows} videos of {steps + 1} frames show no step: there is no horizon to look at")
    longest, first = int(length.max()), real[:, 0]
    out: dict[str, Tensor] = {"horizon": torch.arange(1, longest + 1)}
    out["episodes"] = (length >= out["horizon"].unsqueeze(-1)).sum(-1)
    for prefix, guess in (("", None), ("copy_", first)):
        for name in ("psnr", "moving_psnr"):
            values = torch.full((rows, longest), float("nan"), dtype=torch.float64)
            for step in range(1, longest + 1):
                alive = length >= step
                seen, painted = real[alive, step], imagined[alive, step] if guess is None else guess[alive]
                if name == "psnr":
                    values[alive, step - 1] = psnr(painted, seen).clamp(max=_EQUAL_DB)
                else:
                    values[alive, step - 1] = moving_pixel_psnr(painted, seen, first[alive]).clamp(max=_EQUAL_DB)
            out |= _with_interval(f"{prefix}{name}", values)
    return out


def _with_interval(name: str, values: Tensor) -> dict[str, Tensor]:
    """Mean over the rows that have a value, and 1.96 standard errors to either side."""
    count = values.isfinite().sum(0)
    mean = values.nanmean(0)
    spread = ((values - mean).square().nansum(0) / (count - 1).clamp(min=1)).sqrt()
    half = 1.96 * spread / count.clamp(min=1).sqrt()
    return {name: mean, f"{name}_low": mean - half, f"{name}_high": mean + half}
