"""The whole loop of World-Env (arXiv 2509.24948) in one command.

From five demonstrations per task to a policy post-trained by reinforcement learning inside a learned world model::

    python recipes/world_env.py smoke      # every stage for real, at most 6 minutes on 2 cores
    python recipes/world_env.py improve    # at most 60 minutes on 2 cores
    python recipes/world_env.py improve --help

The same command continues an interrupted run: finished stages are skipped, the running one starts again.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
import tyro

import demonstrate
import evaluate
import explore
import post_train
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
    run: Callable[[WorldEnvConfig, RunFolder], None]


def stages(config: WorldEnvConfig) -> list[Stage]:
    """World-Env's Algorithm 1 as a list; a later round continues from the policy that the round before reached."""
    plan = [Stage("demonstrate", "demonstrate", demonstrate.run), Stage("sft", "sft", sft.run)]
    policy, previous = "sft", None
    if config.post_train.env == "tabletop":  # the upper bound needs neither world model nor reflector
        plan.append(
            Stage("post_train", "post_train", partial(post_train.run, source="sft", target="post_train", models=""))
        )
        evaluation = partial(evaluate.run, before="sft", after="post_train", models=None)
        return [*plan, Stage("evaluate", "evaluate", evaluation)]
    for number in range(1, config.rounds + 1):
        suffix = "" if number == 1 else f"_{number}"
        improved = f"post_train{suffix}"
        plan += [
            Stage(f"explore{suffix}", "explore", partial(explore.run, policy=policy, target=f"explore{suffix}")),
            Stage(
                f"world_model{suffix}",
                "train_world_model",
                partial(
                    train_world_model.run,
                    target=f"world_model{suffix}",
                    previous=previous and f"world_model{previous}",
                    rounds=number,
                ),
            ),
            Stage(
                f"reflector{suffix}",
                "train_reflector",
                partial(train_reflector.run, target=f"reflector{suffix}", models=suffix, rounds=number),
            ),
            Stage(improved, "post_train", partial(post_train.run, source=policy, target=improved, models=suffix)),
        ]
        policy, previous = improved, suffix
    plan.append(Stage("evaluate", "evaluate", partial(evaluate.run, before="sft", after=policy, models=previous or "")))
    return plan


def run_all(config: WorldEnvConfig) -> None:
    """Runs what is not finished yet, then prints the table and writes the plots."""
    folder = _open(config)
    for stage in stages(config):
        if folder.done(stage.name):
            print(f"{stage.name}: finished, skipped")
            continue
        with folder.stage(stage.name):
            stage.run(config, folder)
    plot_run(folder.path)
    print(summary_table(folder.path))


def run_single(kind: str) -> None:
    """Runs one stage of a preset alone, again if it is finished; of several rounds, the first unfinished one."""
    config = parse(sys.argv[1:])
    folder = _open(config)
    plan = [stage for stage in stages(config) if stage.kind == kind]
    stage = next((stage for stage in plan if not folder.done(stage.name)), plan[-1])
    with folder.stage(stage.name):
        stage.run(config, folder)


def parse(arguments: Sequence[str]) -> WorldEnvConfig:
    return tyro.extras.overridable_config_cli(PRESETS, args=arguments, description=__doc__)


def _open(config: WorldEnvConfig) -> RunFolder:
    check_config(config)
    folder = RunFolder(config.run_dir)
    folder.open(config)
    torch.set_num_threads(config.num_threads)
    return folder


if __name__ == "__main__":
    run_all(parse(sys.argv[1:]))
