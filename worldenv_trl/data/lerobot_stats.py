"""Statistics that LeRobot keeps of each feature, for normalisation."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["episode_stats", "joined_stats"]


def episode_stats(values: np.ndarray, *, image: bool = False) -> dict[str, np.ndarray]:
    """min, max, mean, std and count of values [T, n], or of each channel of images uint8 [T, H, W, 3] in [0, 1]."""
    if image:
        flat = values.reshape(-1, 3).astype(np.float64) / 255
        shape: tuple[int, ...] = (3, 1, 1)
    else:
        flat, shape = values.astype(np.float64), (values.shape[1],)
    figures = {"min": flat.min(0), "max": flat.max(0), "mean": flat.mean(0), "std": flat.std(0)}
    return {name: value.reshape(shape) for name, value in figures.items()} | {"count": np.array([len(values)])}


def joined_stats(episodes: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The statistics of all episodes together, from the ``stats/<feature>/<figure>`` of each."""
    features = [key.split("/")[1] for key in episodes[0] if key.startswith("stats/") and key.endswith("/count")]
    out: dict[str, dict[str, Any]] = {}
    for feature in features:
        each = {
            name: np.stack([episode[f"stats/{feature}/{name}"] for episode in episodes])
            for name in ("min", "max", "mean", "std", "count")
        }
        count = each["count"].reshape(-1, *[1] * (each["mean"].ndim - 1))
        mean = (each["mean"] * count).sum(0) / count.sum()
        variance = ((each["std"] ** 2 + (each["mean"] - mean) ** 2) * count).sum(0) / count.sum()
        figures = {"min": each["min"].min(0), "max": each["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
        out[feature] = {name: value.tolist() for name, value in figures.items()} | {"count": [int(count.sum())]}
    return out
