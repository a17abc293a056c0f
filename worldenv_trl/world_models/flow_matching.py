"""Flow matching with x-prediction: noise, and the sampler that removes it in one to four steps."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["add_noise", "sample", "seeded_noise"]


def add_noise(clean: Tensor, noise: Tensor, level: Tensor) -> Tensor:
    """x_level = level * x_0 + (1 - level) * noise (Lipman et al. 2023, straight paths).

    Args:
        clean, noise: [B, ...].
        level: [B] in [0, 1]; 1 is clean.
    """
    level = level.view(-1, *[1] * (clean.ndim - 1))
    return level * clean + (1 - level) * noise


def sample(predict: Callable[[Tensor, Tensor], Tensor], noise: Tensor, num_steps: int) -> Tensor:
    """Integrate dx/dlevel = (x_0(x, level) - x) / (1 - level) from level 0 to 1 in equal Euler steps.

    Args:
        predict: (x [B, ...], level [B]) -> prediction of x_0.
        noise: [B, ...], x at level 0.
        num_steps: calls of ``predict``; the last one's prediction is returned as it is.
    """
    x = noise
    for step in range(num_steps):
        level = step / num_steps
        clean = predict(x, x.new_full((x.shape[0],), level))
        x = x + (clean - x) * (1 / num_steps) / (1 - level)
    return x


def seeded_noise(seed: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Standard normal noise [B, *shape], row by row a function of its own seed alone.

    Args:
        seed: int64 [B] or [B, 1], not negative.
        shape: of one row.
    """
    rows = [torch.randn(shape, generator=torch.Generator().manual_seed(value)) for value in seed.flatten().tolist()]
    return torch.stack(rows).to(seed.device) if rows else torch.zeros(0, *shape, device=seed.device)
