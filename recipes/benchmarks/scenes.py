"""Speed and memory of TabletopEnv: ``python recipes/benchmarks/scenes.py [--quick] [--tasks goal ...]``.

``--tasks`` takes suites, tasks and paths of ``.bddl`` files; all of them are dealt to the rows of one mixed batch (a
batch of fewer rows takes the first ones). The actions are drawn or recorded beforehand and replayed from the same
initial states, so no policy is in the figures. Cells are medians of repeats [lowest, highest]; numbers of threads take
turns within a cell, so that a busy machine slows all of them. With two threads a second process draws once drawing has
taken half a second; the warm-up is long enough for that. Memory is that of the main process.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

import mujoco
import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from command_line import at_least, refusals
from task_names import SUITES, named_tasks
from threads import use_threads
from worldenv_trl.envs import ExpertPolicy, TabletopEnv
from worldenv_trl.keys import ACTION, ACTION_DIM, NUM_STEPS
from worldenv_trl.scenes import ScriptedExpert, Task, list_tasks, load_task

_STANDARD = tuple(name for suite in SUITES for name in list_tasks(suite))
_LONGEST = 64  # steps that are recorded


@dataclass(frozen=True)
class Benchmark:
    """What is measured, and how often."""

    tasks: tuple[str, ...] = ("goal",)
    """Suites, tasks and paths of .bddl files."""
    image_sizes: tuple[int, ...] = (64, 128, 256)
    rows: tuple[int, ...] = (1, 16, 64)
    threads: tuple[int, ...] = (1, 2)
    num_threads: int = 1
    """Of torch, which does little here; those of the scenes are ``threads``."""
    actions: Literal["random", "expert"] = "random"
    """Uniform in [-1, 1], or what the scripted expert does (for tasks it has a script for)."""
    repeats: int = 3
    seconds: float = 0.5
    """Of each repeat, about; at least three steps."""
    warm_up: float = 2.5
    """Seconds that an env plays before it is measured, if processes may come to help it draw."""
    quick: bool = False
    """16 rows at 64 and 128 px, two short repeats."""


class _Replay(TensorDictModuleBase):
    """Writes ``actions [T, n, 7]`` step by step, over and over."""

    def __init__(self, actions: torch.Tensor) -> None:
        super().__init__()
        self.in_keys, self.out_keys, self.actions, self.step = [NUM_STEPS], [ACTION], actions, 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.step += 1
        return tensordict.set(ACTION, self.actions[(self.step - 1) % len(self.actions)])


def make(tasks: list[Task], rows: int, threads: int, size: int = 64, cameras: tuple[str, ...] = ()) -> TabletopEnv:
    return TabletopEnv(
        tasks[:rows], rows, image_size=size, cameras=cameras, init_state_mode="fixed", seed=0, num_threads=threads,
        terminate_on_success=False, max_steps=10**6,
    )  # fmt: skip


def recorded(tasks: list[Task], rows: int, kind: str) -> torch.Tensor:
    """Actions ``[T, rows, 7]`` from the initial state that every env here starts from."""
    if kind == "random":
        return torch.rand(_LONGEST, rows, ACTION_DIM, generator=torch.Generator().manual_seed(0)) * 2 - 1
    env = make(tasks, rows, 1)
    actions = env.rollout(_LONGEST, ExpertPolicy(env), break_when_any_done=False)[ACTION].transpose(0, 1)
    env.close()
    return actions


def seconds_of(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def resident() -> float:
    """Memory of this process now (MB)."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def cell(envs: list[TabletopEnv], actions: torch.Tensor, settings: Benchmark) -> list[list[float]]:
    """Env-steps per second of each env, repeat by repeat; a warm-up before is not counted."""

    def play(env: TabletopEnv, steps: int) -> float:
        start, policy = env.reset(), _Replay(actions)
        return seconds_of(
            lambda: env.rollout(steps, policy, tensordict=start, auto_reset=False, break_when_any_done=False)
        )

    play(envs[0], 2)
    steps = max(3, min(_LONGEST, round(settings.seconds * 3 / play(envs[0], 3))))
    for env, threads in zip(envs, settings.threads, strict=True):
        started = time.perf_counter()
        play(env, min(steps, 10))
        while env.cameras and threads > 1 and time.perf_counter() - started < settings.warm_up:
            play(env, min(steps, 10))
    rates: list[list[float]] = [[] for _ in envs]
    for _ in range(settings.repeats):
        for env, values in zip(envs, rates, strict=True):
            values.append(env.num_envs * steps / play(env, steps))
    return rates


def shown(values: list[float]) -> str:
    return f"{statistics.median(values):>8.0f} [{min(values):.0f}, {max(values):.0f}]"


def check(settings: Benchmark) -> None:
    """Raises before anything is measured."""
    at_least(16, image_sizes=settings.image_sizes)
    at_least(1, rows=settings.rows, threads=settings.threads, repeats=settings.repeats)
    if settings.seconds <= 0:
        raise ValueError(f"--seconds must be positive, got {settings.seconds}")
    for name in named_tasks(settings.tasks):
        if name not in _STANDARD:  # those are fine, and what it takes to load them is measured
            load_task(name).init_states("train", 1)
        if settings.actions == "expert":
            ScriptedExpert(load_task(name))


def main(settings: Benchmark) -> None:
    with refusals():
        check(settings)
        use_threads(settings.num_threads)
    sizes, rows = settings.image_sizes, settings.rows
    if settings.quick:
        settings = dataclasses.replace(settings, repeats=2, seconds=0.2)
        sizes, rows = (64, 128), (16,)
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} cores, load before {load:.1f}, {settings.actions} actions, {settings.repeats} repeats")
    if load > 0.5:
        print("the machine is busy with something else: figures will be too low, those of several threads most of all")

    before, started = resident(), time.perf_counter()
    tasks = [load_task(name) for name in named_tasks(settings.tasks)]
    for task in tasks:
        task.build()
    total, used = time.perf_counter() - started, resident() - before
    size = sum(mujoco.mj_sizeModel(task.build()) for task in tasks) / 1e6
    print(f"{len(tasks)} tasks read, compiled and checked in {total:.2f} s ({1e3 * total / len(tasks):.0f} ms a task)")
    print(f"  memory {used:.1f} MB in the process, of these {size:.1f} MB the compiled models themselves")
    drawing = seconds_of(lambda: [task.init_states("train") for task in tasks])
    print(f"  50 initial states a task in {1e3 * drawing / len(tasks):.0f} ms a task")

    threads, few, many = max(settings.threads), max(16, len(tasks)), 512
    make(tasks[:1], 1, threads, cameras=("agentview",)).close()  # GL is loaded once for all, about 100 MB
    envs, held = [], []
    for count in (few, many):
        before = resident()
        envs.append(make(tasks, count, threads, cameras=("agentview",)))
        envs[-1].rollout(2, break_when_any_done=False)
        held.append(resident() - before)
    resets = [1e3 * seconds_of(envs[0].reset) for _ in range(4 * settings.repeats)]
    for env in envs:
        env.close()
    print(f"reset of {few} rows, 64 px, 1 camera, {threads} threads: {shown(resets)} ms")
    each = (held[1] - held[0]) / (many - few)
    print(f"memory at 64 px, 1 camera: an env of {few} rows {held[0]:.0f} MB, each row more {1e3 * each:.0f} kB")

    head = "".join(f"{f'{count} thread' + 's' * (count > 1):>26}" for count in settings.threads)
    print(f"\n{'env-steps/s':<34}{head}   scaling")
    kinds = [((), sizes[0])] + [(views, size) for views in (("agentview",), ("agentview", "wrist")) for size in sizes]
    for cameras, size in kinds:
        for count in rows:
            actions = recorded(tasks, count, settings.actions)
            envs = [make(tasks, count, threads, size, cameras) for threads in settings.threads]
            rates = cell(envs, actions, settings)
            for env in envs:
                env.close()
            what = f"{size} px, {len(cameras)} camera{'s' * (len(cameras) > 1)}" if cameras else "physics only"
            name = f"{what}, {count} rows, {min(count, len(tasks))} tasks"
            middle = [statistics.median(values) for values in rates]
            cells = "".join(f"{shown(values):>26}" for values in rates)
            print(f"{name:<34}{cells}   {middle[-1] / middle[0]:.2f}", flush=True)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Benchmark, description=__doc__)))
