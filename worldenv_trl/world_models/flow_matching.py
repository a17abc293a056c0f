"""Flow matching with x-prediction: noise, and the sampler that removes it in one to four steps."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from worldenv_trl.splitmix import splitmix64

__all__ = ["add_noise", "counted_noise", "sample", "seeded_noise"]


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
    """Standard normal noise [B, *shape] on the seed's device, row by row a function of its own seed alone.

    On a CPU each row has a generator of its own; elsewhere :func:`counted_noise` draws all rows at once. The same seed
    gives other noise there.

    Args:
        seed: int64 [B] or [B, 1], not negative.
        shape: of one row.
    """
    if seed.device.type != "cpu":
        return counted_noise(seed, shape)
    rows = [torch.randn(shape, generator=torch.Generator().manual_seed(value)) for value in seed.flatten().tolist()]
    return torch.stack(rows) if rows else torch.zeros(0, *shape)


def counted_noise(seed: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Standard normal noise [B, *shape] by counting: element i of a row is a hash of the row's seed and i.

    Nothing is drawn one row after the other, and nothing is asked of the host: what a GPU needs.

    Args:
        seed: int64 [B] or [B, 1].
        shape: of one row.
    """
    count = math.prod(shape)
    pairs = torch.arange(-(-count // 2), device=seed.device)
    bits = splitmix64(splitmix64(seed.reshape(-1, 1)) ^ splitmix64(pairs + 1))  # [B, pairs]
    # 24 bits each, what a float32 holds; the radius must not be that of 0.
    first = (((bits >> 40) & (2**24 - 1)).float() + 1) * 2.0**-24  # (0, 1]
    second = ((bits >> 8) & (2**24 - 1)).float() * 2.0**-24  # [0, 1)
    radius, angle = (-2 * first.log()).sqrt(), 2 * math.pi * second  # Box and Muller 1958
    normal = torch.stack([radius * angle.cos(), radius * angle.sin()], -1).flatten(1)[:, :count]
    return normal.reshape(len(normal), *shape)
