"""The video world model: trained on demonstrations and exploration, on FK-predicted poses, partly on its own frames.

Alone: ``python recipes/train_world_model.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import math
import time

import torch
from config import WorldEnvConfig
from parts import build_world_model, holdout_split, load_world_model, read_episodes, seed_everything
from run_folder import RunFolder
from tqdm import trange

from worldenv_trl import keys
from worldenv_trl.data import WindowSampler
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.metrics import moving_pixel_psnr, psnr
from worldenv_trl.objectives import DiffusionLoss

HORIZONS = (1, 20, 60)


def run(
    config: WorldEnvConfig, folder: RunFolder, target: str = "world_model", previous: str | None = None, round: int = 1
) -> None:
    """Reads the rollouts of rounds up to ``round``; writes ``checkpoints/<target>`` and its held-out fidelity."""
    settings = config.world_model
    seed_everything(config, offset=30 + round)
    training, held_out = holdout_split(read_episodes(folder, round), settings.holdout)
    model = (
        build_world_model(config)
        if previous is None
        else load_world_model(folder, previous.removeprefix("world_model"))
    )
    sampler = WindowSampler(training, ForwardKinematics(), model, seed=config.seed + round)
    loss = DiffusionLoss(model, unroll_prob=settings.unroll_prob)
    steps = settings.steps if previous is None else settings.refit_steps
    optimizer = torch.optim.AdamW(model.parameters(), lr=settings.lr, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / 100) * (0.02 + 0.49 * (1 + math.cos(math.pi * step / steps)))
    )
    progress, started, running = trange(steps, desc=target, unit="step"), time.monotonic(), None
    for step in progress:
        value = loss(sampler.sample(settings.batch_size))["loss_diffusion"]
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        running = value.item() if running is None else 0.98 * running + 0.02 * value.item()
        if step % 50 == 0 or step == steps - 1:
            folder.log(target, step=step, loss=running, steps_per_second=(step + 1) / (time.monotonic() - started))
            progress.set_postfix(loss=f"{running:.4f}")
    model.save_pretrained(folder.checkpoint(target))
    folder.log(target, episodes=len(training), held_out=len(held_out), **fidelity(model, held_out, config.chunk_length))


@torch.no_grad()
def fidelity(model, episodes, chunk_length: int) -> dict[str, float]:
    """PSNR of open-loop imagination at 1, 20 and 60 frames against the recorded frames, beside copying the first frame."""
    from parts import imagine_episodes

    imagined = imagine_episodes(model, episodes, chunk_length)  # [R, T+1, 3, H, W]
    figures: dict[str, float] = {}
    for horizon in HORIZONS:
        alive = (episodes["length"].squeeze(-1) >= horizon).nonzero().squeeze(-1)
        if not len(alive):
            continue
        real, first = episodes["frames"][alive, horizon], episodes["frames"][alive, 0]
        for name, guess in (("model", imagined[alive, horizon]), ("copy", first)):
            figures[f"psnr_{name}_{horizon}"] = psnr(guess, real).mean().item()
            figures[f"moving_psnr_{name}_{horizon}"] = moving_pixel_psnr(guess, real, first).nanmean().item()
    return figures


if __name__ == "__main__":
    from world_env import run_single

    run_single("train_world_model")
