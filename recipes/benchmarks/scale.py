"""Rollouts by workers against rollouts by this process::

    python recipes/benchmarks/scale.py --collectors local process:1 process:2 ray:1 ray:2

For exploration, LOOP's waves in the physics and imagined ones: env steps (or frames) per second of the clock, median of
repeats [their range], and per core-second, the processor time of this process and its workers, everybody with one
thread; then how that compares with the first of the collectors. What Ray's own servers compute is not in it, and a
cluster must be this machine's. The models are untrained: nothing is learned and nothing is kept.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

import torch
import tyro
from tensordict import TensorDictBase

from collecting import check_collectors, of_worker
from command_line import at_least, refusals
from config import Evaluate, Explore, PostTrain, WorldEnvConfig
from imagination import Imagination
from parts import COMPACT
from physics import chunk_player, exploring_actor, physics_waves_env, step_env, tabletop
from run import Run
from run_folder import RunFolder
from speeds import Speed, speed
from threads import OF_A_WORKER, use_threads
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.policies import DeviceBridge
from worldenv_trl.reflectors import StopRule

LEARNED_FROM = ("frames", ("next", "frames"), ("next", "observation"))  # all but these


@dataclass(frozen=True)
class Benchmark:
    """What is measured, and how often."""

    collectors: tuple[str, ...] = ("local", "process:1", "process:2")
    """As the recipes take them; the first is what the others are compared with."""
    repeats: int = 3
    num_envs: int = 32
    """Of a wave of exploration."""
    groups: int = 24
    """Of a wave of LOOP, ..."""
    group_size: int = 8
    """... and rollouts of each."""


def settings_of(settings: Benchmark, collectors: str) -> WorldEnvConfig:
    """A run of that size."""
    return WorldEnvConfig(
        num_threads=OF_A_WORKER,
        device="cpu",
        collectors=collectors,
        explore=Explore(num_envs=settings.num_envs),
        post_train=PostTrain(groups=settings.groups, group_size=settings.group_size),
        evaluate=Evaluate(episodes_per_task=settings.groups, num_envs=settings.groups),
    )


def exploration(run: Run) -> GroupCollector:
    config = run.config
    options = {"terminate_on_success": False, "with_sim_state": True, "seed": 0}
    rows = config.explore.num_envs
    env = step_env(config, "train", rows, **options)
    player = chunk_player(exploring_actor(config, COMPACT.policy.make(config), 1.0), config.chunk_length)
    make = partial(step_env, of_worker(config), "train", **options)
    sizes = {"groups_per_batch": rows, "group_size": 1, "max_decisions": config.max_steps}
    return run.group_collector(env, player, make, steady=True, **sizes)


def physics_waves(run: Run) -> GroupCollector:
    config, sizes = run.config, run.config.post_train
    env = physics_waves_env(config, sizes.groups, sizes.group_size, seed=0)
    actor = DeviceBridge(exploring_actor(config, COMPACT.policy.make(config), 1.0))
    make = partial(physics_waves_env, of_worker(config), group_size=sizes.group_size, seed=0)
    options = {"groups_per_batch": sizes.groups, "group_size": sizes.group_size, "exclude": LEARNED_FROM}
    return run.group_collector(env, actor, make, steady=False, **options)


def imagined_waves(run: Run) -> GroupCollector:
    config, sizes = run.config, run.config.post_train
    starts = tabletop(config, "train", 24, None, seed=0)
    contexts = starts.reset()
    starts.close()
    parts = (part.make(config).eval() for part in (COMPACT.world_model, COMPACT.reflector))
    imagination = Imagination(*parts, StopRule(0.999), contexts)
    env = imagination.env(run, [sizes.groups, sizes.group_size], seed=0)
    actor = DeviceBridge(exploring_actor(config, COMPACT.policy.make(config), 1.0))
    make = imagination.makes(run, sizes.group_size, seed=0)
    return run.group_collector(env, actor, make, steady=False, groups_per_batch=sizes.groups, exclude=LEARNED_FROM)


WORK: dict[str, Callable[[Run], GroupCollector]] = {
    "exploration": exploration,
    "LOOP's waves, physics": physics_waves,
    "LOOP's waves, imagined": imagined_waves,
}


def steps(wave: TensorDictBase) -> float:
    """Env steps of a wave, or frames."""
    mask = wave[keys.MASK]
    executed = wave["next"].get(keys.STEP_MASK, None)
    return float(mask.sum() if executed is None else (executed & mask[..., None]).sum())


def main(settings: Benchmark) -> None:
    with refusals():
        at_least(1, repeats=settings.repeats)
        if not settings.collectors:
            raise ValueError("--collectors is empty: name at least one, for instance process:2")
        for collectors in settings.collectors:
            check_collectors(settings_of(settings, collectors))
        use_threads(1)
    print(f"{'':<26}{'collectors':<14}{'per second':>11} {'[range]':<18}", end="")
    print(f"{'per core-second':>16}{'speed-up':>10}{'start, s':>10}")
    found: dict[str, Speed] = {}
    for collectors in settings.collectors:
        with tempfile.TemporaryDirectory() as folder, refusals():
            started = time.perf_counter()
            with closing(Run(settings_of(settings, collectors), RunFolder(folder))) as run:
                if run.workers is not None:
                    run.workers.map(time.process_time, [()])
                ready = time.perf_counter() - started
                for name, make in WORK.items():
                    measured = _measured(run, make, settings.repeats)
                    first = found.setdefault(name, measured)
                    span = f"[{min(measured.per_second):,.0f}, {max(measured.per_second):,.0f}]"
                    print(
                        f"{name:<26}{collectors:<14}{measured.wall:>11,.0f} {span:<18}{measured.core:>16,.0f}"
                        f"{measured.wall / first.wall:>10.2f}{ready:>10.1f}",
                        flush=True,
                    )


def _measured(run: Run, make: Callable[[Run], GroupCollector], repeats: int) -> Speed:
    torch.manual_seed(0)
    collector = make(run)
    elsewhere = getattr(run.workers, "pids", []) if run.config.collectors.startswith("ray") else []
    together = getattr(collector, "waves_at_once", 1)
    measured = speed(lambda: sum(steps(collector.next()) for _ in range(together)), repeats, processes=elsewhere)
    collector.shutdown()
    return measured


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
