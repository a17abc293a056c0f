"""Draws the standard initial states of tasks and stores them beside their files (``.npz``), over those that are there.

``python recipes/init_states.py``, after a file of the suites has changed, or ``--tasks mine.bddl`` for one's own; 50 of
each split, fixed by the file's text. Every state is tried: one that the scripted expert does not solve is drawn again.
"""

from __future__ import annotations

import multiprocessing
from dataclasses import dataclass
from functools import partial

import numpy as np
import tyro

from command_line import at_least, refusals
from task_names import SUITES, named_tasks
from threads import use_threads
from worldenv_trl.scenes import SceneBatch, ScriptedExpert, Task, load_task
from worldenv_trl.scenes.initial import save_poses


@dataclass(frozen=True)
class Settings:
    """What is drawn."""

    tasks: tuple[str, ...] = SUITES
    """Suites, tasks of them, and files."""
    count: int = 50
    """States of each split."""
    processes: int = 2
    """One thread each."""


def main(settings: Settings) -> None:
    with refusals():
        at_least(1, count=settings.count, processes=settings.processes)
        use_threads(1)
        names = named_tasks(settings.tasks)
        for name in names:
            ScriptedExpert(load_task(name))  # what it has no skill for is said before anything is drawn
        with multiprocessing.get_context("spawn").Pool(settings.processes) as pool:
            for lines in pool.imap(partial(store, count=settings.count), names):
                print("\n".join(lines), flush=True)


def store(name: str, count: int) -> list[str]:
    """Draws and stores the states of a task; what there is to say about it."""
    task = load_task(name)
    assert task.states is not None  # a suite's
    redrawn = save_poses(task, task.states, count, partial(solved_by_expert, task))
    lines = [f"{name}: {count} + {count} states, {task.states.stat().st_size / 1024:.0f} kB"]
    for split, times in redrawn.items():
        for index in np.flatnonzero(times):
            lines.append(
                f"  {split} {index}: drawn {times[index] + 1} times, the expert did not solve what came before"
            )
    return lines


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
