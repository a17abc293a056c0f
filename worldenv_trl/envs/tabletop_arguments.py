"""What TabletopEnv refuses, in words."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from pathlib import Path

import numpy as np

from worldenv_trl.context_ids import MOST_STATES
from worldenv_trl.keys import image_entry
from worldenv_trl.scenes import Task, load_task
from worldenv_trl.scenes.simulation import cameras_of

__all__ = ["check_cameras", "check_counts", "check_flags", "check_numbers", "check_whole", "task_numbers", "tasks_of"]

_EXAMPLE = "'starter/open_the_top_drawer'"
_LONGEST = 2**31 - 1  # steps
_LARGEST_ID = 2**31 - 1  # context ids, a hundred thousand times that, still fit into int64


def check_whole(name: str, value: object, low: int, high: int | None = None, why: str = "") -> None:
    """Raises ``ValueError`` unless ``value`` is a whole number from ``low`` to ``high``; ``why`` explains ``high``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < low:
        raise ValueError(f"{name} must be a whole number of at least {low}, got {value!r}")
    if high is not None and int(value) > high:
        raise ValueError(f"{name} must be at most {high}, got {value}{why and f': {why}'}")


def check_numbers(
    num_envs: object,
    group_repeats: object,
    num_threads: object,
    seed: object,
    max_steps: object,
    init_state_count: object,
    init_state_id: object,
) -> None:
    """Raises ``ValueError`` unless each of these is a whole number within its bounds, or None where it may be."""
    why = "context ids tell no more of a split apart"
    check_whole("num_envs", num_envs, 1)
    check_whole("group_repeats", group_repeats, 1)
    check_whole("num_threads", 1 if num_threads is None else num_threads, 1)
    check_whole("seed", 0 if seed is None else seed, 0)
    check_whole("max_steps", 1 if max_steps is None else max_steps, 1, _LONGEST)
    check_whole("init_state_count", init_state_count, 1, MOST_STATES, why)
    check_whole("init_state_id", init_state_id, 0, MOST_STATES - 1, why)


def check_flags(**values: object) -> None:
    """Raises ``TypeError`` unless all are True or False: what merely counts as true is often meant otherwise."""
    for name, value in values.items():
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


def task_numbers(task_ids: object, tasks: Sequence[Task]) -> tuple[int, ...]:
    """The number of each task: ``task_ids``, or its place among ``tasks``.

    Raises:
        TypeError: if they are no sequence.
        ValueError: unless there is one whole number of at least 0 for each task, no two alike.
    """
    if task_ids is None:
        return tuple(range(len(tasks)))
    if isinstance(task_ids, str) or not isinstance(task_ids, Sequence):
        raise TypeError(f"task_ids must be a sequence of whole numbers, got {task_ids!r}: write (0, 1)")
    if len(task_ids) != len(tasks):
        raise ValueError(f"got {len(tasks)} tasks and {len(task_ids)} task_ids: give each task one")
    for number in task_ids:
        check_whole("a task id", number, 0, _LARGEST_ID)
    if len(set(task_ids)) < len(task_ids):
        raise ValueError(f"two tasks have one id: task_ids are {', '.join(map(str, task_ids))}")
    return tuple(int(number) for number in task_ids)


def check_cameras(cameras: object, tasks: Sequence[Task]) -> None:
    """Raises ``TypeError`` or ``ValueError`` unless ``cameras`` are distinct names of cameras that all tasks have."""
    if isinstance(cameras, str):
        raise ValueError(f"cameras must be a sequence of names, got {cameras!r}: write ({cameras!r},)")
    if not isinstance(cameras, Sequence):
        raise TypeError(f"cameras must be a sequence of names, got {cameras!r}: write () for no images")
    for task in tasks if cameras else ():
        known = cameras_of(task)
        for name in cameras:
            if name not in known:
                raise ValueError(f"unknown camera {name!r}: {task.name} has {', '.join(known)}")
    if len(set(cameras)) < len(cameras):
        raise ValueError(f"a camera is named twice: {', '.join(cameras)}")
    entries = [image_entry(name) for name in cameras]
    if len({*entries, "state"}) <= len(entries):
        raise ValueError(f"the images of {', '.join(cameras)} would be written over one another: rename a camera")


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
