"""What a caller may ask of the reader, checked before any file is opened."""

from __future__ import annotations

import os
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

__all__ = ["check_arguments"]

_KEYS = 'a list of entries, such as ["action", ("next", "reward")]'
_TIME = "two numbers, the first and the last second"
_ROLLOUTS = "a number, a slice or a list of numbers"


def check_arguments(
    path: Any, task: Any = None, rollouts: Any = None, time: Any = None, steps: Any = None, keys: Any = None
) -> None:
    """Raises TypeError or ValueError for arguments of :func:`read_rollouts` that make no sense."""
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path must be a file, a folder or a pattern, got {path!r}")
    if not os.fspath(path):
        raise ValueError("path is empty: name a file, a folder or a pattern")
    if task is not None and not isinstance(task, str):
        raise TypeError(f"task must be a name such as 'goal/open_the_top_drawer', got {task!r}")
    whole = rollouts is None or isinstance(rollouts, slice) or _is_number(rollouts)
    if not whole and not (_is_list(rollouts) and all(map(_is_number, rollouts))):
        raise TypeError(f"rollouts must be {_ROLLOUTS}, got {rollouts!r}")
    if time is not None:
        if not isinstance(time, tuple | list) or len(time) != 2 or not all(isinstance(each, Real) for each in time):
            raise TypeError(f"time must be {_TIME}, got {time!r}")
        if not time[0] <= time[1]:
            raise ValueError(f"time must be {_TIME}, in this order, got {time!r}")
    if steps is not None and not isinstance(steps, slice):
        raise TypeError(f"steps must be a slice, such as slice(0, 10), got {steps!r}")
    if keys is not None and not (_is_list(keys) and all(isinstance(key, str) or _is_path(key) for key in keys)):
        raise TypeError(f"keys must be {_KEYS}, got {keys!r}")


def _is_number(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _is_list(value: object) -> bool:
    return isinstance(value, Sequence | set) and not isinstance(value, str)


def _is_path(key: object) -> bool:
    return isinstance(key, tuple) and bool(key) and all(isinstance(part, str) for part in key)
