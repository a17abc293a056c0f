"""Of which task a recorded rollout is: what the file itself calls its tasks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["task_names", "task_numbers"]


def task_names(metadata: Mapping[str, Any]) -> list[str]:
    """The tasks that a file's metadata name, as ``tasks`` or ``task``."""
    named = metadata.get("tasks", metadata.get("task", []))
    return [named] if isinstance(named, str) else list(named)


def task_numbers(metadata: Mapping[str, Any]) -> list[int] | None:
    """The ``task_id`` of each of them in the rollouts, None where the file does not say."""
    numbers = metadata.get("task_ids")
    return None if numbers is None else [int(number) for number in numbers]
