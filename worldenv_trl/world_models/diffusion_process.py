"""Diffusion with v-prediction and a terminal signal of zero: its schedule, and DDIM in any number of steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

__all__ = ["TRAIN_STEPS", "ddim", "make_scheduler"]

TRAIN_STEPS = 1000
_MOST_ETA = 0.999  # with 1 diffusers takes the root of 1 - a - (1 - a), a rounding error below zero at some step counts


def make_scheduler() -> Any:
    """Diffusers' ``DDIMScheduler`` as EVAC has it: variances from 0.00085 to 0.012, rescaled so that the last step is
    pure noise (Lin et al. 2024), v-prediction, steps counted from the noisy end."""
    from diffusers import DDIMScheduler

    with torch.device("cpu"):  # a few numbers, which are read
        return DDIMScheduler(
            num_train_timesteps=TRAIN_STEPS,
            beta_start=0.00085,
            beta_end=0.012,
            beta_schedule="scaled_linear",
            prediction_type="v_prediction",
            rescale_betas_zero_snr=True,
            timestep_spacing="trailing",
            clip_sample=False,
        )


def ddim(
    scheduler: Any,
    predict_v: Callable[[Tensor, int], Tensor],
    noise: Tensor,
    num_steps: int,
    eta: float = 0.0,
    draw: Callable[[int], Tensor] | None = None,
) -> Tensor:
    """From noise to what it was made of.

    Args:
        scheduler: see :func:`make_scheduler`.
        predict_v: (x [B, ...], timestep) -> v of the same shape.
        noise: [B, ...], x at the last timestep.
        num_steps: calls of ``predict_v``.
        eta: 0 adds no noise between steps, 1 as much as DDPM.
        draw: noise like ``noise`` for step 1, 2, ...; needed with an ``eta``.
    """
    scheduler.set_timesteps(num_steps)
    x = noise
    for number, timestep in enumerate(scheduler.timesteps.tolist()):
        added = draw(number + 1) if eta > 0 and draw is not None and number + 1 < num_steps else torch.zeros_like(x)
        v = predict_v(x, timestep).to(x.dtype)
        x = scheduler.step(v, timestep, x, eta=min(eta, _MOST_ETA), variance_noise=added).prev_sample
    return x
