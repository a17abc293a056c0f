"""Success and length of the scripted expert on every standard initial state.

``python recipes/benchmarks/expert.py`` prints a table in Markdown: 50 training and 50 held-out states of each task. Two
processes share the work, each on one thread.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

from command_line import at_least, refusals
from task_names import SUITES, named_tasks
from threads import use_threads
from worldenv_trl.context_ids import SPLITS
from worldenv_trl.metrics import wilson_interval
from worldenv_trl.scenes import SceneBatch, ScriptedExpert, list_suites, load_task


@dataclass(frozen=True)
class Settings:
    """What is counted."""

    tasks: tuple[str, ...] = ()
    """Tasks, suites or files; none: every task of the four suites."""
    count: int = 50
    """Initial states of each split."""
    processes: int = 2
    num_threads: int = 1
    """Of each process."""


def main(settings: Settings) -> None:
    with refusals():
        at_least(1, count=settings.count, processes=settings.processes)
        use_threads(settings.num_threads)
        tasks = named_tasks(settings.tasks or list_suites())
        for name in settings.tasks:
            if name not in SUITES:
                task = load_task(name)
                ScriptedExpert(task), task.init_states("train", 1)
    start = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(settings.processes) as pool:
        results = pool.starmap(
            count_successes, [(name, settings.count, settings.num_threads) for name in tasks], chunksize=1
        )
    seconds = time.perf_counter() - start
    print("| task | solved | steps, median | steps, 95 % | not solved |\n|---|---|---|---|---|")
    for name, lengths in zip(tasks, results, strict=True):
        solved = lengths[lengths > 0]
        lost = [f"{SPLITS[i // settings.count]} {i % settings.count}" for i in np.flatnonzero(lengths < 0)]
        median, high = (f"{np.percentile(solved, q):.0f}" if len(solved) else "" for q in (50, 95))
        print(f"| {name} | {len(solved)} / {len(lengths)} | {median} | {high} | {', '.join(lost)} |")
    everything = np.concatenate(results)
    low, high = wilson_interval(int((everything > 0).sum()), len(everything))
    print(f"\n{(everything > 0).sum()} of {len(everything)} episodes ({100 * low:.1f} to {100 * high:.1f} %)", end=" ")
    print(f"in {seconds:.0f} s, {(np.abs(everything)).sum() / seconds:.0f} control steps a second")


def count_successes(name: str, count: int, num_threads: int) -> np.ndarray:
    """``[2 * count]``: steps to success of each initial state, training ones first; minus those taken if in vain."""
    task = load_task(name)
    states = np.concatenate([task.init_states(split, count) for split in SPLITS])
    scene, expert = SceneBatch(task, len(states), cameras=(), num_threads=num_threads), ScriptedExpert(task)
    scene.reset(np.arange(len(states)), states)
    lengths = np.full(len(states), -task.max_steps)
    for step in range(1, task.max_steps + 1):
        scene.step(expert(scene), active=lengths < 0)
        lengths[scene.success() & (lengths < 0)] = step
        if (lengths > 0).all():
            break
    return lengths


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
