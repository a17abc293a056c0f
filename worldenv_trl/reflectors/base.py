"""What every reflector is: R(o_1:t, g), the probability that the task is done by frame t (World-Env section 3.3)."""

from __future__ import annotations

import abc

import torch
from torch import Tensor, nn

__all__ = ["Reflector", "prefix_indices"]


def prefix_indices(lengths: Tensor, num_frames: int) -> Tensor:
    """Which frames of a prefix are looked at: spread evenly, the first and the last among them.

    Args:
        lengths: int64 ``[P]``, frames in each prefix, at least 1.
        num_frames: most frames looked at.

    Returns:
        int64 ``[P, L]`` with ``L = min(num_frames, max(lengths))``; shorter prefixes repeat their last frame.
    """
    count = int(min(num_frames, int(lengths.max())))
    slots = torch.arange(count, device=lengths.device)
    shown = lengths.clamp(max=count)
    spread = (slots * (lengths - 1).unsqueeze(-1)).float() / (shown - 1).clamp(min=1).unsqueeze(-1)
    return torch.minimum(spread.round().long(), (lengths - 1).unsqueeze(-1))


class Reflector(nn.Module, abc.ABC):
    """Frozen encoder and reward head.

    Subclasses encode frames one by one and score prefixes of the features; :meth:`prefix_scores` gives the scores of
    all prefixes of a chunk in one batch.
    """

    num_frames: int = 32
    feature_dim: int

    @abc.abstractmethod
    def encode(self, frames: Tensor) -> Tensor:
        """Features ``[n, F]`` of frames uint8 ``[n, 3, H, W]``; never differentiated."""

    @abc.abstractmethod
    def logits(self, features: Tensor, lengths: Tensor, task_id: Tensor) -> Tensor:
        """Log-odds ``[P]`` that the task is done.

        Args:
            features: ``[P, L, F]``, sampled frames of each prefix in order, short ones padded at the end.
            lengths: int64 ``[P]``, frames in use.
            task_id: int64 ``[P, 1]``.
        """

    def score(self, features: Tensor, lengths: Tensor, task_id: Tensor) -> Tensor:
        """Probabilities ``[P]``; see :meth:`logits`."""
        return self.logits(features, lengths, task_id).sigmoid()

    def sample_prefixes(
        self, features: Tensor, rows: Tensor, lengths: Tensor, num_frames: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Evenly sampled frames of prefixes: ``[P, L, F]`` and how many are in use ``[P]``.

        Args:
            features: ``[B, T, F]`` of whole videos.
            rows: int64 ``[P]``, the video of each prefix.
            lengths: int64 ``[P]``, its number of frames.
            num_frames: most frames looked at; the reflector's own when None.
        """
        index = prefix_indices(lengths, self.num_frames if num_frames is None else num_frames)
        return features[rows.unsqueeze(-1), index], lengths.clamp(max=index.shape[1])

    def prefix_scores(
        self, features: Tensor, first: Tensor, count: int, task_id: Tensor, num_frames: int | None = None
    ) -> Tensor:
        """Scores of the prefixes that end at each of ``count`` new frames, in one batch.

        Args:
            features: ``[B, T, F]`` of all frames so far, the new ones included.
            first: int64 ``[B]``, frames before the new ones.
            count: new frames ``C``.
            task_id: int64 ``[B, 1]``.
            num_frames: most frames of a prefix that are looked at; the reflector's own when None.

        Returns:
            ``[B, C]``: entry k is the score of the prefix of ``first + k + 1`` frames.
        """
        batch = len(features)
        lengths = (first.unsqueeze(-1) + torch.arange(1, count + 1, device=first.device)).flatten()
        rows = torch.arange(batch, device=first.device).repeat_interleave(count)
        sampled, used = self.sample_prefixes(features, rows, lengths, num_frames)
        return self.score(sampled, used, task_id[rows]).reshape(batch, count)
