"""Draws the standard initial states of the suites' tasks and stores them beside their files, over those that are there.

``python recipes/init_states.py``, after a task file has changed; 50 of each split, fixed by the file's text.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from worldenv_trl.scenes import list_suites, list_tasks, load_task
from worldenv_trl.scenes.initial import save_poses


@dataclass(frozen=True)
class Settings:
    """What is drawn."""

    suites: tuple[str, ...] = tuple(list_suites())
    count: int = 50
    """States of each split."""


def main(settings: Settings) -> None:
    unknown = set(settings.suites) - set(list_suites())
    if unknown:
        raise SystemExit(f"unknown suite {unknown.pop()!r}: it must be one of {', '.join(list_suites())}")
    for suite in settings.suites:
        for name in list_tasks(suite):
            task = load_task(name)
            save_poses(task, task.states, settings.count)
            print(f"{name}: {settings.count} + {settings.count} states, {task.states.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
