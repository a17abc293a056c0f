"""What TabletopEnv refuses, in words."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from numbers import Integral
from pathlib import Path

import numpy as np

from worldenv_trl.scenes import Task, load_task

__all__ = ["check_cameras", "check_counts", "check_flag", "check_whole", "tasks_of"]

_EXAMPLE = "'starter/open_the_top_drawer'"


def check_whole(name: str, value: object, low: int, high: int | None = None, why: str = "") -> None:
    """Raises ``ValueError`` unless ``value`` is a whole number from ``low`` to ``high``; ``why`` explains ``high``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
        raise ValueError(f"{name} must be a whole number of at least {low}, got {value!r}")
    if high is not None and value > high:
        raise ValueError(f"{name} must be at most {high}, got {value}{why and f': {why}'}")


def check_flag(name: str, value: object) -> None:
    """Raises ``TypeError`` unless ``value`` is True or False: what merely counts as true is often meant otherwise."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")


def tasks_of(task: object) -> list[Task]:
    """The tasks that the argument ``task`` names.

    Raises:
        TypeError: if it is, or holds, something that names no task.
    """
    names = [task] if isinstance(task, str | Path | Task) else task
    if not isinstance(names, Sequence):
        raise TypeError(f"task must be a task, its name or file, or a list of those, got {task!r}: try {_EXAMPLE}")
    for item in names:
        if not isinstance(item, str | Path | Task):
            raise TypeError(f"task must list tasks, their names or files, got {item!r} among them: try {_EXAMPLE}")
    return [item if isinstance(item, Task) else load_task(item) for item in names]


def check_cameras(cameras: object, known: Collection[str]) -> None:
    """Raises ``TypeError`` or ``ValueError`` unless ``cameras`` is a sequence of distinct ``known`` names."""
    if isinstance(cameras, str):
        raise ValueError(f"cameras must be a sequence of names, got {cameras!r}: write ({cameras!r},)")
    if not isinstance(cameras, Sequence):
        raise TypeError(f"cameras must be a sequence of names, got {cameras!r}: write () for no images")
    for name in cameras:
        if name not in known:
            raise ValueError(f"unknown camera {name!r}: it must be one of {', '.join(known)}")
    if len(set(cameras)) < len(cameras):
        raise ValueError(f"a camera is named twice: {', '.join(cameras)}")


def check_counts(tasks: Sequence[Task], num_envs: int, group_repeats: int) -> None:
    """Raises ``ValueError`` unless the rows can be dealt to groups and those to distinct tasks."""
    if not tasks:
        raise ValueError(f"task is empty: name at least one, for instance {_EXAMPLE}")
    if len({task.name for task in tasks}) < len(tasks):
        raise ValueError(f"a task is named twice: {', '.join(task.name for task in tasks)}")
    if num_envs % group_repeats:
        raise ValueError(f"num_envs must be a multiple of group_repeats, got {num_envs} and {group_repeats}")
    if num_envs // group_repeats < len(tasks):
        raise ValueError(f"{len(tasks)} tasks need at least {len(tasks) * group_repeats} rows, got num_envs={num_envs}")
