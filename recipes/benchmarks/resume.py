"""A run that is killed again and again against one that is not: ``python recipes/benchmarks/resume.py [--kills 20]``.

The same small run, all seven stages, is made twice: once without a break, once by processes that get SIGKILL at random
moments, the kills being dealt to the stages in turn, and that are started again on the same folder. The weights of
every part, every recorded rollout and every figure in ``metrics.jsonl`` but times must be the same, bit for bit. Lost
is what a kill undoes: the time since the newest checkpoint of its stage, or since the process took up the stage.
"""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import random
import signal
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from command_line import at_least, refusals
from config import (
    GOAL_TASKS,
    PRESETS,
    SFT,
    Demonstrate,
    Evaluate,
    Explore,
    PostTrain,
    Reflector,
    WorldEnvConfig,
    WorldModel,
)
from run_folder import RunFolder
from stages import open_run, plan, run_stages
from world_env import WORKS
from worldenv_trl.record import read_rollouts

_START = multiprocessing.get_context("forkserver")  # imports torch once for all processes
_START.set_forkserver_preload(["world_env"])


@dataclass(frozen=True)
class Benchmark:
    """How often the run is killed."""

    kills: int = 20
    minutes: float = 0.02
    """Between two checkpoints."""
    seed: int = 0
    """Of the moments and of the run."""
    num_threads: int = 1
    stages: tuple[str, ...] = ()
    """In which it is killed, for instance ``demonstrate explore reflector``; all of them when empty."""


@dataclass(frozen=True)
class Kill:
    stage: str
    lost: float
    """Seconds."""


def small(path: Path, settings: Benchmark) -> WorldEnvConfig:
    """Half a minute of computing for all stages."""
    return dataclasses.replace(
        PRESETS["smoke"][1],
        run_dir=path,
        seed=settings.seed,
        num_threads=settings.num_threads,
        checkpoint_minutes=settings.minutes,
        tasks=GOAL_TASKS[:2],
        train_states=8,
        demonstrate=Demonstrate(episodes_per_task=1),
        sft=SFT(steps=20, scale_steps=10, batch_size=8),
        explore=Explore(episodes_per_task=16, num_envs=4, scale_factors=(0.5, 2.0)),
        world_model=WorldModel(steps=10, batch_size=2),
        reflector=Reflector(encoder_frames=8, prefixes=10, batch_size=4),
        post_train=PostTrain(iterations=3, groups=2, group_size=2, epochs=2, probe_every=2, probe_contexts=2),
        evaluate=Evaluate(episodes_per_task=2, num_envs=2),
    )


def work(config: WorldEnvConfig) -> None:
    """What a process does."""
    run_stages(open_run(config), WORKS)


def started(config: WorldEnvConfig) -> BaseProcess:
    process = _START.Process(target=work, args=(config,))
    process.start()
    return process


def ended(process: BaseProcess) -> None:
    """Waits for the end; raises ``RuntimeError`` if it was not a good one."""
    process.join()
    if process.exitcode != 0:
        raise RuntimeError(f"a process ended with code {process.exitcode}")


def killed_run(config: WorldEnvConfig, stage_seconds: dict[str, float], settings: Benchmark) -> list[Kill]:
    """Kills as many processes as asked for, then lets the last one finish."""
    draw, folder, kills = random.Random(settings.seed), RunFolder(config.run_dir), []
    names = list(stage_seconds)
    targets = [names.index(name) for name in settings.stages or names]
    while len(kills) < settings.kills:
        place = targets[len(kills) * len(targets) // settings.kills]
        if folder.done(names[place]):  # nothing would be left to kill of it
            for name in names[place:]:
                folder.forget(name)
        before = _written(folder)
        process = started(config)
        # A stage that begins writes the metrics anew.
        while process.is_alive() and (_written(folder) == before or not all(map(folder.done, names[:place]))):
            time.sleep(0.01)
        begun = time.time()
        process.join(draw.uniform(0.0, stage_seconds[names[place]]))
        if not process.is_alive():
            ended(process)  # faster than it was without a break: once more
            continue
        process.kill()
        at = time.time()
        process.join()
        if process.exitcode == 0:
            continue  # it was over in that very moment
        if process.exitcode != -signal.SIGKILL:
            raise RuntimeError(f"the process that should be killed ended by itself, with code {process.exitcode}")
        stage = next((name for name in names if not folder.done(name)), names[-1])
        kept = [path.stat().st_mtime for path in folder.progress(stage).glob("*.torchrl")]
        kept += [(folder.path / "stages" / name).stat().st_mtime for name in names if folder.done(name)]
        kills.append(Kill(stage, at - max([begun, *(moment for moment in kept if moment < at)])))
        print(f"\nkill {len(kills)} in {stage}, {kills[-1].lost:.1f} s lost", flush=True)
    ended(started(config))
    return kills


def _written(folder: RunFolder) -> int:
    """When the metrics were written last."""
    return folder.metrics_path.stat().st_mtime_ns if folder.metrics_path.exists() else 0


def differences(first: Path, second: Path, stages: list[str]) -> list[str]:
    """Weights, recordings and figures in which two run folders differ."""
    found = []
    for part in sorted(path.relative_to(first) for path in (first / "checkpoints").rglob("*") if path.is_file()):
        other = second / part
        if not other.is_file() or other.read_bytes() != (first / part).read_bytes():
            found.append(str(part))
    for path in sorted((first / "rollouts").iterdir()):
        other = second / "rollouts" / path.name
        if not other.is_file() or not _same(read_rollouts(path), read_rollouts(other)):
            found.append(str(path.relative_to(first)))
    for stage in stages:
        texts = [[_timeless(line) for line in RunFolder(path).read_metrics(stage)] for path in (first, second)]
        if texts[0] != texts[1]:
            found.append(f"metrics of {stage}")
    return found


def _same(first: TensorDict, second: TensorDict) -> bool:
    """Whether two recordings hold the same entries, bit for bit."""
    if first.shape != second.shape or set(first.keys(True, True)) != set(second.keys(True, True)):
        return False
    pairs = ((first.get(key), second.get(key)) for key in first.keys(True, True))
    return all(_content(mine) == _content(other) for mine, other in pairs)


def _content(value: Any) -> Any:
    return value.contiguous().numpy().tobytes() if isinstance(value, torch.Tensor) else value.tolist()


def _timeless(line: dict) -> str:
    return json.dumps({name: value for name, value in line.items() if "second" not in name})


def main(settings: Benchmark) -> None:
    with refusals():
        at_least(0, kills=settings.kills, seed=settings.seed)
        at_least(1, num_threads=settings.num_threads)
        known = [stage.name for stage in plan(small(Path(), settings))]
        for name in settings.stages:
            if name not in known:
                raise ValueError(f"--stages must be among {', '.join(known)}, got {name!r}")
        if not settings.minutes >= 0:
            raise ValueError(f"--minutes must be at least 0, got {settings.minutes}")
    with tempfile.TemporaryDirectory() as name:
        folders = [Path(name) / each for each in ("straight", "killed")]
        straight, killed = (small(folder, settings) for folder in folders)
        begun = time.monotonic()
        ended(started(straight))
        whole, stages = time.monotonic() - begun, [stage.name for stage in plan(straight)]
        seconds = {stage: RunFolder(folders[0]).read_metrics(stage)[-1]["seconds"] for stage in stages}
        print(f"without a break: {whole:.0f} s; " + ", ".join(f"{stage} {each:.1f}" for stage, each in seconds.items()))
        kills = killed_run(killed, seconds, settings)
        found = differences(*folders, stages)
        parts = sorted(path.name for path in (folders[0] / "checkpoints").iterdir())
    lost = [kill.lost for kill in kills]
    counts = {stage: sum(kill.stage == stage for kill in kills) for stage in stages}
    print(f"killed {len(kills)} times, by stage: " + ", ".join(f"{stage} {count}" for stage, count in counts.items()))
    if lost:
        ends = statistics.median(lost), max(lost), sum(lost) / 60
        print(f"lost: {ends[0]:.1f} s (median), {ends[1]:.1f} s (most), {ends[2]:.2f} minutes in all")
    print(
        f"{', '.join(parts)}, all recordings and all figures: "
        + ("bit for bit the same" if not found else f"differ in {found}")
    )
    if found:
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
