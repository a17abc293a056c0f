"""The whole loop of World-Env (arXiv 2509.24948) in one command.

From five demonstrations per task to a policy post-trained by reinforcement learning inside a learned world model::

    python recipes/world_env.py smoke      # every stage for real, at most 6 minutes on 2 cores
    python recipes/world_env.py improve    # meant to raise held-out success: at most 60 minutes on 2 cores
    python recipes/world_env.py improve --help

The same command continues an interrupted run: finished stages are skipped, the running one starts again.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
import tyro

import demonstrate
import evaluate
import explore
import post_train
import report
import sft
import train_reflector
import train_world_model
from config import PRESETS, WorldEnvConfig
from parts import check_config
from run_folder import RunFolder
from worldenv_trl.report import plot_run, summary_table


@dataclass(frozen=True)
class Stage:
    name: str
    kind: str
    makes: str
    """What it leaves in the run folder; without it the stage counts as not finished."""
    run: Callable[[WorldEnvConfig, RunFolder], None]


def stages(config: WorldEnvConfig) -> list[Stage]:
    """World-Env's Algorithm 1 as a list; a later round continues from the policy that the round before reached."""
    plan = [
        Stage("demonstrate", "demonstrate", "rollouts/demonstrations.mcap", demonstrate.run),
        Stage("sft", "sft", "checkpoints/sft", sft.run),
    ]
    if config.post_train.env == "tabletop":  # the upper bound needs neither world model nor reflector
        learn = partial(post_train.run, source="sft", target="post_train", models="")
        judge = partial(evaluate.run, before="sft", after="post_train", models=None)
        plan.append(Stage("post_train", "post_train", "checkpoints/post_train", learn))
        return [*plan, Stage("evaluate", "evaluate", "metrics.jsonl", judge)]
    policy, previous, models = "sft", None, ""
    for number in range(1, config.rounds + 1):
        models = "" if number == 1 else f"_{number}"
        explored, world, judge, improved = (
            f"{name}{models}" for name in ("explore", "world_model", "reflector", "post_train")
        )
        see = partial(explore.run, policy=policy, target=explored)
        dream = partial(train_world_model.run, target=world, previous=previous, rounds=number)
        score = partial(train_reflector.run, target=judge, models=models, rounds=number)
        learn = partial(post_train.run, source=policy, target=improved, models=models)
        plan += [
            Stage(explored, "explore", f"rollouts/{explored}.mcap", see),
            Stage(world, "train_world_model", f"checkpoints/{world}", dream),
            Stage(judge, "train_reflector", f"checkpoints/{judge}", score),
            Stage(improved, "post_train", f"checkpoints/{improved}", learn),
        ]
        policy, previous = improved, world
    judge = partial(evaluate.run, before="sft", after=policy, models=models)
    return [*plan, Stage("evaluate", "evaluate", "metrics.jsonl", judge)]


def run_all(config: WorldEnvConfig) -> None:
    """Runs what is not finished yet, then prints the table and writes the plots and the report."""
    folder = _open(config)
    for stage in stages(config):
        if _finished(stage, folder):
            print(f"{stage.name}: finished, skipped")
        else:
            _run(stage, config, folder)
    plot_run(folder.path)
    print(summary_table(folder.path))
    episodes = max(min(config.evaluate.episodes_per_task // 5, report.Report.episodes_per_task), 1)
    try:
        report.write(report.Report(folder.path, episodes_per_task=episodes, num_threads=config.num_threads))
    except Exception as error:  # the run itself is whole
        again = f"python recipes/report.py {folder.path}"
        print(f"warning: the report could not be written ({error}); after a remedy: {again}", file=sys.stderr)


def run_single(kind: str) -> None:
    """Runs one stage of a preset alone, again if it is finished; of several rounds, the first unfinished one.

    The stages after it, which learned from what it made before, count as not finished from then on.
    """
    config = parse(sys.argv[1:])
    folder = _open(config)
    plan = stages(config)
    same = [index for index, stage in enumerate(plan) if stage.kind == kind]
    if not same:
        raise SystemExit(f"these settings have no stage {kind!r}: {', '.join(stage.name for stage in plan)}")
    index = next((index for index in same if not _finished(plan[index], folder)), same[-1])
    for later in plan[index + 1 :]:
        folder.forget(later.name)
    _run(plan[index], config, folder)


def _finished(stage: Stage, folder: RunFolder) -> bool:
    return folder.done(stage.name) and (folder.path / stage.makes).exists()


def _run(stage: Stage, config: WorldEnvConfig, folder: RunFolder) -> None:
    """Runs a stage; Ctrl-C ends the program with one line, wherever it strikes."""
    interrupted = threading.Event()

    def interrupt(number: int, frame: object) -> None:
        interrupted.set()
        signal.default_int_handler(number, frame)

    here = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, interrupt) if here else None
    try:
        with folder.stage(stage.name):
            stage.run(config, folder)
    except BaseException as error:
        if not interrupted.is_set():
            raise
        # Libraries may have turned the KeyboardInterrupt into an error of their own.
        message = f"interrupted in stage {stage.name}: the same command continues"
        raise SystemExit(f"\n{message}, finished stages are kept") from error
    finally:
        if here:
            signal.signal(signal.SIGINT, before)


def parse(arguments: Sequence[str]) -> WorldEnvConfig:
    return tyro.extras.overridable_config_cli(PRESETS, args=arguments, description=__doc__)


def _open(config: WorldEnvConfig) -> RunFolder:
    """The run folder of checked settings; what is wrong with them is said in one line."""
    try:
        check_config(config)
        folder = RunFolder(config.run_dir)
        folder.open(config)
    except (ValueError, OSError, RuntimeError) as error:
        raise SystemExit(f"error: {error}") from error
    torch.set_num_threads(config.num_threads)
    return folder


if __name__ == "__main__":
    run_all(parse(sys.argv[1:]))
