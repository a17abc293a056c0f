"""The video world model: trained on demonstrations and exploration, on FK-predicted poses, partly on its own frames.

Alone: ``python recipes/train_world_model.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import math
import time
from typing import Any

import torch

import processes
from data_parallel import DataParallel, WholeOptimizer
from episodes import demonstrations_and_exploration, split_by_context
from fidelity import fidelity
from resumable import Resumable
from run import Run
from stages import run_alone
from worldenv_trl.data import Episodes, WindowBuffer, window_buffer
from worldenv_trl.objectives import WorldModelLoss
from worldenv_trl.world_models import WorldModel


def train_world_model(run: Run, target: str = "world_model", previous: str | None = None, rounds: int = 1) -> None:
    """Reads the rollouts of the first ``rounds`` rounds; writes ``checkpoints/<target>`` and its held-out fidelity."""
    settings = run.config.world_model
    run.seed_everything(target)
    demonstrated, explored = demonstrations_and_exploration(run, rounds)
    training, held_out = split_by_context(explored, settings.holdout, run.seed("held-out contexts"))
    training = Episodes.cat([demonstrated, training])
    if previous is None:
        model, steps = run.new("world_model"), settings.steps
    else:
        model, steps = run.world_model(previous.removeprefix("world_model")), settings.refit_steps
    parameters = [parameter for parameter in model.train().parameters() if parameter.requires_grad]
    if parameters:
        options = {"failure_share": settings.failure_share, "seed": run.seed(target, "windows")}
        rows = settings.batch_size // processes.size()
        windows = window_buffer(training, run.kinematics, model, batch_size=rows, **options)
        _train(run, model, parameters, windows, steps, target)
    model.eval()
    if processes.is_main():
        model.save_pretrained(run.folder.checkpoint(target))
    figures = processes.on_main(lambda: fidelity(run, model, held_out, run.seed(target, "fidelity")))
    run.folder.log(target, episodes=len(training), held_out=len(held_out), **figures)


def _train(
    run: Run, model: WorldModel, parameters: list[torch.nn.Parameter], windows: WindowBuffer, steps: int, target: str
) -> None:
    settings, learner = run.config.world_model, DataParallel(model, WorldModelLoss, run.config.parallel)
    parameters = learner.trained(parameters)
    optimizer = torch.optim.AdamW(parameters, lr=settings.lr, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / 100) * (0.02 + 0.49 * (1 + math.cos(math.pi * step / steps)))
    )
    shown: dict[str, Any] = {"loss": None}  # its running mean
    parts: dict[str, Any] = {"model": learner, "optimizer": WholeOptimizer(optimizer)}
    parts |= {"schedule": schedule, "windows": windows}
    left = Resumable(run, "steps", steps, shown=shown, **parts)
    progress, started, first = left.bar(target), time.monotonic(), left.step
    for step in progress:
        with processes.sharing():
            batch = windows.sample()
            out = learner(batch)
        optimizer.zero_grad()
        value = learner.backward_mean(out["loss_world_model"], out.get("weight", batch.numel()))
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        shown["loss"] = value.item() if shown["loss"] is None else 0.98 * shown["loss"] + 0.02 * value.item()
        if step % 50 == 0 or step == steps - 1:
            speed = (step + 1 - first) / (time.monotonic() - started)
            run.folder.log(target, step=step, loss=shown["loss"], steps_per_second=speed)
            progress.set_postfix(loss=f"{shown['loss']:.4f}")
    learner.close()


if __name__ == "__main__":
    run_alone("train_world_model", train_world_model)
