"""How brittle five demonstrations a task leave a policy: SFT on a suite, greedy success on held-out initial states.

``python recipes/benchmarks/sft.py --suite spatial --run-dir runs/sft_spatial`` (one policy for the suite's ten tasks);
with pretrained eyes and chosen demonstrations ``--sft.vision-blocks 2 4 10 --demonstrate.states spread``. What is to be
chosen by its result is measured on ``--states validation``, which no stage draws from and the evaluation does not see.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from checks import check_config
from command_line import at_least, refusals
from config import SFT, Demonstrate, WorldEnvConfig, WorldModel
from demonstrate import demonstrate
from learning_curves import VALIDATION_FROM
from outcomes import physics_outcomes
from run import Run
from run_folder import RunFolder
from sft import fine_tune
from threads import use_threads
from worldenv_trl.metrics import wilson_interval
from worldenv_trl.policies import policy_actor
from worldenv_trl.scenes import list_tasks, load_task


@dataclass(frozen=True)
class Settings:
    """What is trained and counted."""

    run_dir: Path
    suite: str = "spatial"
    episodes_per_task: int = 20
    """Initial states of each task on which success is counted, the first ones."""
    states: Literal["held-out", "validation"] = "held-out"
    """Of these: the held-out ones, or training states from number 1,000 on."""
    cameras: tuple[str, ...] = ("agentview",)
    image_size: int = 64
    seed: int = 0
    num_threads: int = 2
    device: str = "auto"
    """Of the policy: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one."""
    train_states: int = 50
    """Of each task, among which the demonstrations' are."""
    demonstrate: Demonstrate = field(default_factory=Demonstrate)
    sft: SFT = field(default_factory=lambda: SFT(steps=3000))


def main(settings: Settings) -> None:
    with refusals():
        at_least(1, episodes_per_task=settings.episodes_per_task)
        tasks = tuple(list_tasks(settings.suite))
    steps = 8 * -(-load_task(tasks[0]).max_steps // 8)  # whole chunks
    config = WorldEnvConfig(
        run_dir=settings.run_dir,
        seed=settings.seed,
        num_threads=settings.num_threads,
        device=settings.device,
        tasks=tasks,
        cameras=settings.cameras,
        image_size=settings.image_size,
        # Not made here, but checked: a patch that suits its grid.
        world_model=WorldModel(patch=max(1, settings.image_size // 16)),
        max_steps=steps,
        train_states=settings.train_states,
        demonstrate=settings.demonstrate,
        sft=settings.sft,
    )
    with refusals():
        check_config(config)
        folder = RunFolder(config.run_dir)
        folder.open(config)
    use_threads(config.num_threads)
    run = Run(config, folder)
    if not folder.checkpoint("sft").is_dir():  # else only counted, perhaps on other states
        demonstrate(run)
        fine_tune(run)
    run.seed_everything("evaluate")
    actor = policy_actor(run.policy("sft"))
    print("| task | solved |\n|---|---|")
    everything, count = [], settings.episodes_per_task
    split, first = ("test", 0) if settings.states == "held-out" else ("train", VALIDATION_FROM)
    for task in tasks:
        everything.append(physics_outcomes(run, actor, task, split, count, indices=range(first, first + count)))
        print(f"| {task} | {int(everything[-1].sum())} / {len(everything[-1])} |", flush=True)
    success = torch.cat(everything)
    rate, (low, high) = success.float().mean(), wilson_interval(int(success.sum()), len(success))
    print(f"\n{settings.suite}, {settings.states}, seed {settings.seed}: {rate:.1%} [{low:.1%}, {high:.1%}]")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
