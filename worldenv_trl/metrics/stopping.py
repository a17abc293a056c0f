"""How well a reflector's scores, and the rule that stops by them, tell when a task is done."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from worldenv_trl.metrics.classification import classification
from worldenv_trl.reflectors import StopRule

__all__ = [
    "choose_rule",
    "first_success",
    "frame_figures",
    "judged",
    "largest_scores",
    "loop_returns",
    "stop_figures",
]

_RULES = tuple(StopRule(threshold, run) for threshold in (0.5, 0.6, 0.7, 0.8, 0.9, 0.95) for run in (1, 2, 3, 4))


def first_success(success: Tensor) -> Tensor:
    """First True of bool [R, T + 1], int64 [R]; -1 where there is none."""
    return torch.where(success.any(1), success.long().argmax(1), -1)


def judged(stop: Tensor, reached: Tensor, late: int = 2) -> tuple[Tensor, Tensor]:
    """What imagination says of each row, and whether it is so.

    Args:
        stop: int64 [R], where imagination stops a row as done (:meth:`StopRule.first`); -1 if never.
        reached: int64 [R], where the physics first reaches the goal under the same actions; -1 if never.
        late: frames by which the physics may come after the stop: imagined time is not exact.

    Returns:
        ``imagined``, ``real`` bool [R]. The stop ends the episode: a goal that is reached later does not count.

    Examples:
        >>> stop, reached = torch.tensor([10, 10, -1]), torch.tensor([12, 30, 30])
        >>> imagined, real = judged(stop, reached)
        >>> imagined.tolist(), real.tolist()
        ([True, True, False], [True, False, True])
    """
    imagined = stop >= 0
    real = (reached >= 0) & (~imagined | (reached <= stop + late))
    return imagined, real


def loop_returns(scores: Tensor, stop: Tensor, alive: Tensor) -> Tensor:
    """The return of each rollout as LOOP takes it: R where the rule stops it or, if never, at its last frame.

    What :class:`~worldenv_trl.envs.Reflect` pays along a rollout (World-Env section 3.3), on whole videos.

    Args:
        scores: [R, T + 1], R(o_1:t, g).
        stop: int64 [R], the frame at which a row is stopped (:meth:`StopRule.first`); -1 if never.
        alive: bool [R, T + 1], frames that belong to their episode.

    Returns:
        [R].

    Examples:
        >>> scores = torch.tensor([[0.1, 0.2, 0.9, 0.3], [0.1, 0.2, 0.3, 0.4]])
        >>> alive = torch.tensor([[True, True, True, True], [True, True, True, False]])
        >>> loop_returns(scores, torch.tensor([2, -1]), alive)
        tensor([0.9000, 0.3000])
    """
    end = torch.where(stop >= 0, stop, alive.sum(1) - 1)
    return scores.gather(1, end.unsqueeze(-1)).squeeze(-1)


def largest_scores(scores: Tensor, alive: Tensor) -> Tensor:
    """Largest of ``scores`` [R, T + 1] in each video, [R]; its first frame counts only where it is ``alive`` alone."""
    shown = alive.clone()
    shown[:, 0] &= alive.sum(1) == 1
    return scores.masked_fill(~shown, -torch.inf).amax(1)


def frame_figures(scores: Tensor, success: Tensor, alive: Tensor, threshold: float = 0.5) -> dict[str, float]:
    """``frame_precision``, ``frame_recall``, ``frame_f1`` and ``frame_auc`` of scores as predictions of each frame.

    Args:
        scores: [R, T + 1], R(o_1:t, g).
        success: bool [R, T + 1], whether the goal holds at the frame.
        alive: bool [R, T + 1], frames that belong to their episode; at least one.
        threshold: predicted true above it.
    """
    figures = classification(scores[alive], success[alive], threshold)
    return {f"frame_{name}": value for name, value in dataclasses.asdict(figures).items()}


def stop_figures(scores: Tensor, success: Tensor, alive: Tensor, rule: StopRule, late: int = 0) -> dict[str, float]:
    """Precision and recall of stopping: a stop is right if the goal has been reached by then, or ``late`` frames on.

    Args:
        scores: [R, T + 1], R(o_1:t, g).
        success: bool [R, T + 1], whether the goal holds at the frame.
        alive: bool [R, T + 1], frames that belong to their episode.
        rule: of stopping.
        late: frames by which the goal may be reached after the stop.

    Returns:
        ``stop_precision``, of the episodes that are stopped; ``stop_recall``, of those that reach the goal. 0 where
        there are none.

    Examples:
        >>> scores, success = torch.tensor([[0.1, 0.2, 0.9], [0.1, 0.9, 0.1]]), torch.tensor([[False, False, True]] * 2)
        >>> stop_figures(scores, success, torch.ones(2, 3, dtype=torch.bool), StopRule(0.5))
        {'stop_precision': 0.5, 'stop_recall': 0.5}
    """
    stop, reached = rule.first(scores, alive), first_success(success)
    right = (stop >= 0) & (reached >= 0) & (reached <= stop + late)
    return {
        "stop_precision": right.sum().item() / max(int((stop >= 0).sum()), 1),
        "stop_recall": right.sum().item() / max(int((reached >= 0).sum()), 1),
    }


def choose_rule(scores: Tensor, success: Tensor, alive: Tensor, task: Tensor, late: int = 0) -> StopRule:
    """The rule with the best F0.5 of stopping, averaged over tasks; the first of the best, the laxest.

    Precision counts twice: LOOP learns whatever stops a rollout, wrong stops first of all.

    Args:
        scores, success, alive, late: as for :func:`stop_figures`; of episodes that the reflector was not trained on.
        task: int64 [R] or [R, 1], the task of each episode.
    """
    task = task.reshape(-1)

    def f_half(rule: StopRule) -> float:
        each = []
        for number in task.unique():
            rows = task == number
            figures = stop_figures(scores[rows], success[rows], alive[rows], rule, late)
            precision, recall = figures["stop_precision"], figures["stop_recall"]
            each.append(1.25 * precision * recall / max(0.25 * precision + recall, 1e-9))
        return sum(each) / len(each)

    return max(_RULES, key=f_half)
