"""Which frames of a growing video are looked at."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["prefix_indices"]


def prefix_indices(lengths: Tensor, num_frames: int) -> Tensor:
    """Which frames of a prefix are looked at: spread evenly, the first and the last among them.

    Args:
        lengths: int64 [P], frames in each prefix, at least 1.
        num_frames: most frames looked at.

    Returns:
        int64 [P, L] with ``L = min(num_frames, max(lengths))``; shorter prefixes repeat their last frame.
    """
    count = int(min(num_frames, int(lengths.max())))
    slots = torch.arange(count, device=lengths.device)
    shown = lengths.clamp(max=count)
    spread = (slots * (lengths - 1).unsqueeze(-1)).float() / (shown - 1).clamp(min=1).unsqueeze(-1)
    return torch.minimum(spread.round().long(), (lengths - 1).unsqueeze(-1))
