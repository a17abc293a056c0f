"""Draws the standard initial states of the suites' tasks and stores them beside their files, over those that are there.

``python recipes/init_states.py``, after a task file has changed; 50 of each split, fixed by the file's text. Every
state is tried: one that the scripted expert does not solve is drawn again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import tyro

from worldenv_trl.scenes import SceneBatch, ScriptedExpert, Task, list_suites, list_tasks, load_task
from worldenv_trl.scenes.initial import save_poses


@dataclass(frozen=True)
class Settings:
    """What is drawn."""

    suites: tuple[str, ...] = tuple(list_suites())
    tasks: tuple[str, ...] = ()
    """Tasks, ``suite/name``; none: every task of the suites."""
    count: int = 50
    """States of each split."""


def main(settings: Settings) -> None:
    unknown = set(settings.suites) - set(list_suites())
    if unknown:
        raise SystemExit(f"unknown suite {unknown.pop()!r}: it must be one of {', '.join(list_suites())}")
    known = [name for suite in list_suites() for name in list_tasks(suite)]
    unknown = set(settings.tasks) - set(known)
    if unknown:
        raise SystemExit(f"{unknown.pop()!r} is no task of the suites: tasks are written suite/name")
    for name in settings.tasks or [name for name in known if name.split("/")[0] in settings.suites]:
        task = load_task(name)
        redrawn = save_poses(task, task.states, settings.count, partial(solved_by_expert, task))
        print(f"{name}: {settings.count} + {settings.count} states, {task.states.stat().st_size / 1024:.0f} kB")
        for split, times in redrawn.items():
            for index in np.flatnonzero(times):
                print(f"  {split} {index}: drawn {times[index] + 1} times, the expert did not solve what came before")


def solved_by_expert(task: Task, states: np.ndarray) -> np.ndarray:
    """``[n]`` bool: the scripted expert reaches the goal from ``states [n, S]`` within the task's steps."""
    scene, expert = SceneBatch(task, len(states), cameras=(), num_threads=1), ScriptedExpert(task)
    scene.reset(np.arange(len(states)), states)
    solved = scene.success()
    for _ in range(task.max_steps):
        scene.step(expert(scene), active=~solved)
        solved |= scene.success()
        if solved.all():
            break
    return solved


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
