"""What recording costs: ``python recipes/benchmarks/record.py``.

Overhead of a recorder on TabletopEnv, sizes, write and read rates.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

from command_line import refusals
from threads import use_threads
from worldenv_trl import keys
from worldenv_trl.envs import TabletopEnv
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.record import RolloutWriter, read_rollouts, recorded

TASK = "starter/put_the_bowl_on_the_plate"


@dataclass(frozen=True)
class Benchmark:
    """What is measured, and how often."""

    rows: int = 64
    image_size: int = 64
    steps: int = 30
    repeats: int = 8
    num_threads: int = 1


def report(name: str, unit: str, values: list[float]) -> None:
    print(f"{name:<58} {statistics.median(values):>9.2f} {unit}   [{min(values):.2f}, {max(values):.2f}]", flush=True)


def make_env(settings: Benchmark) -> TabletopEnv:
    size = settings.image_size
    options = {"image_size": size, "seed": 0, "terminate_on_success": False, "num_threads": settings.num_threads}
    return TabletopEnv(TASK, settings.rows, with_sim_state=True, **options)


def overhead(settings: Benchmark, folder: Path) -> TensorDict:
    """Times rollouts with and without a recorder, in turns, and the processor time of the recorder alone."""
    plain = make_env(settings)
    envs = {
        "recorder": recorded(make_env(settings), folder / "plain.mcap"),
        "recorder with FK": recorded(make_env(settings), folder / "fk.mcap", kinematics=ForwardKinematics()),
    }
    spent = {name: 0.0 for name in envs}
    for name, env in envs.items():
        _count(env.transform, spent, name)

    def run(env) -> tuple[float, float]:
        cpu, wall = time.process_time(), time.perf_counter()
        env.rollout(settings.steps, break_when_any_done=False)
        return time.perf_counter() - wall, time.process_time() - cpu

    for env in (plain, *envs.values()):
        run(env)
    base, figures = [], {name: ([], [], []) for name in envs}
    for _ in range(settings.repeats):
        base.append(run(plain))
        for name, env in envs.items():
            thread = env.transform._stream._thread
            spent[name], before = 0.0, _thread_seconds(thread)
            wall, cpu = run(env)
            env.transform.flush()
            behind = _thread_seconds(thread) - before
            figures[name][0].append(wall)
            figures[name][1].append(100 * (spent[name] + behind) / (cpu - spent[name] - behind))
            figures[name][2].append(100 * spent[name] / wall)
    walls = [wall for wall, _ in base]
    report(f"TabletopEnv, {settings.rows} rows, {settings.image_size} px, without", "s", walls)
    for name, (wall, share, caller) in figures.items():
        report(f"  with {name}", "s", wall)
        slower = [100 * (one / other - 1) for one, other in zip(wall, walls, strict=True)]
        report("    wall time against the rollout before it without", "%", slower)
        report("    processor time, both threads, against the env's", "%", share)
        report("    of the wall time in the env's own thread", "%", caller)
        envs[name].close()
    path = folder / "plain.mcap"
    entries = int(read_rollouts(path, keys=[keys.NUM_STEPS])[keys.MASK].sum())
    print(f"{'  size of the recorded file':<58} {path.stat().st_size / entries:>9.0f} B/env-step")
    return plain.rollout(settings.steps, break_when_any_done=False)


def _count(transform, spent: dict[str, float], name: str) -> None:
    """Adds up the processor time that the env's own thread spends in a transform."""
    inner = transform._step

    def timed(*arguments):
        started = time.thread_time()
        out = inner(*arguments)
        spent[name] += time.thread_time() - started
        return out

    transform._step = timed


def _thread_seconds(thread) -> float:
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def rates(settings: Benchmark, rollouts: TensorDict, folder: Path) -> None:
    count = rollouts.numel()
    written, read, steps = [], [], []
    flat = rollouts.reshape(-1)
    thousand = flat[torch.arange(1000) % len(flat)].reshape(25, 40)
    for index in range(settings.repeats):
        started = time.perf_counter()
        with RolloutWriter(folder / f"{index}.mcap") as writer:
            writer.write(rollouts)
        written.append(count / (time.perf_counter() - started))
        with RolloutWriter(folder / "thousand.mcap", overwrite=True) as writer:
            writer.write(thousand.exclude(keys.INSTRUCTION, ("next", keys.INSTRUCTION)))
        started = time.perf_counter()
        read_rollouts(folder / "thousand.mcap")
        read.append(1000 * (time.perf_counter() - started))
        started = time.perf_counter()
        read_rollouts(folder / f"{index}.mcap", rollouts=3)
        steps.append(1000 * (time.perf_counter() - started))
    report("finished rollouts, written", "env-steps/s", written)
    print(f"{'  size':<58} {(folder / '0.mcap').stat().st_size / count:>9.0f} B/env-step")
    report("1,000 steps, read", "ms", read)
    report(f"one rollout of {len(rollouts)}, read", "ms", steps)


def main(settings: Benchmark) -> None:
    with refusals():
        use_threads(settings.num_threads)
    print(f"median of {settings.repeats} [range]")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rollouts = overhead(settings, folder)
        rates(settings, rollouts, folder)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
