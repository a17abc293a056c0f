"""The instant reflector: trained on real and imagined rollouts, and the rules by which it stops them.

Imagined rollouts are replays of recorded actions in the world model, labelled by what the physics did under them; who
looks at no video in imagination needs none.
Alone: ``python recipes/train_reflector.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import torch

import processes
from data_parallel import DataParallel, WholeOptimizer
from episodes import demonstrations_and_exploration, split_by_context
from imagining import imagined
from resumable import Resumable
from run import LATE, Run, write_rules
from stages import run_alone
from worldenv_trl import keys
from worldenv_trl.data import Episodes, score_episodes
from worldenv_trl.metrics import choose_rule, frame_figures, stop_figures
from worldenv_trl.objectives import ReflectorLoss
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.reflectors import Reflector, StopRule


def train_reflector(run: Run, target: str = "reflector", models: str = "", rounds: int = 1) -> None:
    """Reads the rollouts of the first ``rounds`` rounds; writes ``checkpoints/<target>`` and its held-out figures."""
    config, settings = run.config, run.config.reflector
    run.seed_everything(target)
    demonstrated, explored = demonstrations_and_exploration(run, rounds)
    training, held_out = split_by_context(explored, settings.holdout, run.seed("held-out contexts"))
    world_model = run.world_model(models)
    share = min(1.0, settings.imagined_share / max(1e-6, 1 - settings.imagined_share))
    chosen = torch.randperm(len(training))[: round(share * len(training))]
    with run.folder.lasting_scratch() as scratch:

        def imagine(episodes: Episodes, name: str) -> Episodes:
            return imagined(run, world_model, episodes, target, name, scratch)

        reflector: Reflector = run.new("reflector")
        episodes, shown = [demonstrated, training], {"real": held_out, "imagined": held_out}
        if reflector.for_world("imagined").reads_video:
            if len(chosen):
                episodes.append(imagine(training[chosen], "training"))
            shown["imagined"] = imagine(held_out, "held out")
        learn(run, reflector, Episodes.cat([part.through(world_model.cameras) for part in episodes]), target)
        reflector.eval()
        scores = {world: score_episodes(reflector.for_world(world), each) for world, each in shown.items()}
    rules = dict.fromkeys(scores, StopRule(settings.threshold, settings.consecutive))
    if settings.choose_threshold:  # on training contexts that no part of the reflector has seen
        number = held_out[keys.TASK_ID].squeeze(-1)
        rules = {
            name: choose_rule(values, held_out["success"], held_out.alive, number, LATE[name])
            for name, values in scores.items()
        }
    if processes.is_main():
        write_rules(cast(Pretrained, reflector).save_pretrained(run.folder.checkpoint(target)), rules)
    for name, values in scores.items():
        for task in ("all", *config.tasks):
            rows = torch.ones(len(held_out), dtype=torch.bool)
            if task != "all":
                rows = held_out[keys.TASK_ID].squeeze(-1) == config.tasks.index(task)
            if rows.any():
                _log_figures(run, target, rules[name], name, task, values[rows], held_out[rows])


def learn(run: Run, reflector: Reflector, episodes: Episodes, target: str) -> None:
    """The reflector's lessons, one after the other; none for one that needs no training."""
    for number, lesson in enumerate(reflector.train_on(episodes)):
        learner = DataParallel(reflector, ReflectorLoss, run.config.parallel)
        own = learner.trained(lesson.parameters)
        optimizer = torch.optim.AdamW(own, lr=lesson.lr, weight_decay=lesson.weight_decay)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lesson.lr, total_steps=lesson.steps)
        parts: dict[str, Any] = {"reflector": learner, "optimizer": WholeOptimizer(optimizer), "schedule": schedule}
        left = Resumable(run, f"{number}_{lesson.name}", lesson.steps, **parts)
        for step in left.bar(f"{target} {lesson.name}"):
            batch = processes.own_share(lesson.sample())
            out = learner(batch)
            optimizer.zero_grad()
            value = learner.backward_mean(out["loss_reflector"], batch.numel())
            optimizer.step()
            schedule.step()
            if step % 50 == 0:
                accuracy = processes.mean(out["accuracy"], batch.numel())
                figures = {"loss": value.item(), "accuracy": accuracy.item()}
                run.folder.log(target, step=step, **{f"{lesson.name}_{name}": each for name, each in figures.items()})
        learner.close()


def _log_figures(
    run: Run, target: str, rule: StopRule, rollouts: str, task: str, scores: torch.Tensor, episodes: Episodes
) -> None:
    success, alive = episodes["success"], episodes.alive
    run.folder.log(
        target,
        rollouts=rollouts,
        task=task,
        episodes=len(episodes),
        **dataclasses.asdict(rule),
        **frame_figures(scores, success, alive, rule.threshold),
        **stop_figures(scores, success, alive, rule, LATE[rollouts]),
    )


if __name__ == "__main__":
    run_alone("train_reflector", train_reflector)
