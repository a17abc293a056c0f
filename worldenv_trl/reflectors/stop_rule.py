"""When a score ends a rollout."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["StopRule"]


@dataclass(frozen=True)
class StopRule:
    """A rollout ends at the last of the first ``consecutive`` frames in a row whose scores are above ``threshold``.

    The first frame of a video, seen before anything was done, never counts. World-Env's rule (section 3.3) is
    ``StopRule(0.5, 1)``. This is the only implementation: :class:`~worldenv_trl.envs.Reflect` streams chunks through
    :meth:`extend`, figures and the choice of a rule (:mod:`worldenv_trl.metrics`) call :meth:`first` on whole videos.

    Args:
        threshold: in (0, 1); a score must be above it.
        consecutive: frames, at least 1.

    Raises:
        ValueError: for a threshold or a number of frames out of range.

    Examples:
        >>> scores = torch.tensor([[0.9, 0.6, 0.2, 0.7, 0.8, 0.9]])
        >>> alive = torch.ones(1, 6, dtype=torch.bool)
        >>> StopRule(0.5, 1).first(scores, alive), StopRule(0.5, 2).first(scores, alive)
        (tensor([1]), tensor([4]))
    """

    threshold: float = 0.5
    consecutive: int = 1

    def __post_init__(self) -> None:
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must be in (0, 1), got {self.threshold}")
        if self.consecutive < 1 or not float(self.consecutive).is_integer():
            raise ValueError(f"consecutive must be a whole number, at least 1, got {self.consecutive}")

    def extend(self, streak: Tensor, scores: Tensor, executed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Judges the next frames of n rollouts.

        Args:
            streak: int64 [n], frames in a row above the threshold so far.
            scores: [n, C], C at least 1.
            executed: bool [n, C], False where a frame does not belong to its rollout.

        Returns:
            ``stop`` bool [n]; ``last`` int64 [n], the index of the frame that ends the rollout, or of its last executed
            one (-1 if there is none); the new streak.
        """
        reached = []
        for index in range(scores.shape[1]):
            above = (scores[:, index] > self.threshold) & executed[:, index]
            streak = torch.where(above, streak + 1, torch.zeros_like(streak))
            reached.append(streak >= self.consecutive)
        crossing = torch.stack(reached, 1)
        stop = crossing.any(1)
        return stop, torch.where(stop, crossing.long().argmax(1), executed.sum(1) - 1), streak

    def first(self, scores: Tensor, alive: Tensor) -> Tensor:
        """The frame at which each of R whole videos is stopped, int64 [R]; -1 if never.

        Args:
            scores: [R, T + 1], of every frame.
            alive: bool [R, T + 1], frames that belong to their video.
        """
        if scores.shape[1] < 2:
            return torch.full((len(scores),), -1, device=scores.device)
        none = torch.zeros(len(scores), dtype=torch.int64, device=scores.device)
        stop, last, _ = self.extend(none, scores[:, 1:], alive[:, 1:])
        return torch.where(stop, last + 1, -1)
