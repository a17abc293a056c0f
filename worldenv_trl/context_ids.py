"""Numbers of initial states: which task of a run, which split, which state of it."""

from __future__ import annotations

__all__ = ["MOST_STATES", "SPLITS", "UNKNOWN_CONTEXT", "context_id", "parts_of"]

SPLITS = ("train", "test")
MOST_STATES = 50_000  # of a split: so many numbers are set aside for it, and beyond them begin another's
UNKNOWN_CONTEXT = -1  # a state given by the caller without a number
_PER_TASK = len(SPLITS) * MOST_STATES


def context_id(task_id: int, split: str, index: int) -> int:
    """The number of initial state ``index`` of a split; distinct over all tasks of a run and both splits.

    Raises:
        ValueError: for an index out of [0, 50,000).
    """
    if not 0 <= index < MOST_STATES:
        raise ValueError(f"the index of an initial state must be in [0, {MOST_STATES}), got {index}")
    return task_id * _PER_TASK + SPLITS.index(split) * MOST_STATES + index


def parts_of(number: int) -> tuple[int, str, int]:
    """Task id, split and index that a :func:`context_id` is made of."""
    task_id, rest = divmod(number, _PER_TASK)
    split, index = divmod(rest, MOST_STATES)
    return task_id, SPLITS[split], index
