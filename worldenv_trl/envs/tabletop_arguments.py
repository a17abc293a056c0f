"""What TabletopEnv refuses, in words."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

from worldenv_trl.scenes import Task

__all__ = ["check_counts", "check_whole"]


def check_whole(name: str, value: object, low: int) -> None:
    """Raises ``ValueError`` unless ``value`` is a whole number of at least ``low``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
        raise ValueError(f"{name} must be a whole number of at least {low}, got {value!r}")


def check_counts(tasks: Sequence[Task], num_envs: int, group_repeats: int) -> None:
    """Raises ``ValueError`` unless the rows can be dealt to groups and those to distinct tasks."""
    if not tasks:
        raise ValueError("task is empty: name at least one, for instance 'starter/open_the_top_drawer'")
    if len({task.name for task in tasks}) < len(tasks):
        raise ValueError(f"a task is named twice: {', '.join(task.name for task in tasks)}")
    if num_envs % group_repeats:
        raise ValueError(f"num_envs must be a multiple of group_repeats, got {num_envs} and {group_repeats}")
    if num_envs // group_repeats < len(tasks):
        raise ValueError(f"{len(tasks)} tasks need at least {len(tasks) * group_repeats} rows, got num_envs={num_envs}")
