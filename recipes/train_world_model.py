"""The video world model: trained on demonstrations and exploration, on FK-predicted poses, partly on its own frames.

Alone: ``python recipes/train_world_model.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import math
import time

import torch
from tensordict import TensorDict
from tqdm import trange

from config import WorldEnvConfig
from parts import load_world_model, read_episodes, seed_everything, split_by_context
from run_folder import RunFolder
from worldenv_trl.data import WindowSampler, concatenate_episodes
from worldenv_trl.data.imagine import imagine_episodes
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.metrics import moving_pixel_psnr, psnr
from worldenv_trl.objectives import DiffusionLoss
from worldenv_trl.scenes import load_task
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig

HORIZONS = (1, 20, 40, 56, 60)


def run(
    config: WorldEnvConfig, folder: RunFolder, target: str = "world_model", previous: str | None = None, rounds: int = 1
) -> None:
    """Reads the rollouts of the first ``rounds`` rounds; writes ``checkpoints/<target>`` and its held-out fidelity."""
    settings = config.world_model
    seed_everything(config, offset=30 + rounds)
    demonstrations, explored = read_episodes(folder, rounds)
    training, held_out = split_by_context(explored, settings.holdout, config.seed)
    training = concatenate_episodes([demonstrations, training])
    model = new_model(config) if previous is None else load_world_model(folder, previous.removeprefix("world_model"))
    model.train()
    sampler = WindowSampler(
        training, ForwardKinematics(), model, failure_share=settings.failure_share, seed=config.seed + rounds
    )
    loss = DiffusionLoss(model, unroll_prob=settings.unroll_prob, frames_per_chunk=settings.frames_per_chunk)
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
    model.eval().save_pretrained(folder.checkpoint(target))
    folder.log(target, episodes=len(training), held_out=len(held_out), **fidelity(model, held_out))


def new_model(config: WorldEnvConfig) -> VideoWorldModel:
    """An untrained model for the cameras of the tasks."""
    cameras = {task.task_id: task.camera("agentview") for task in map(load_task, config.tasks)}
    return VideoWorldModel(
        VideoWorldModelConfig.for_cameras(
            cameras,
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            num_denoise_steps=config.world_model.denoise_steps,
            deterministic=config.world_model.deterministic,
        )
    )


def fidelity(model: VideoWorldModel, episodes: TensorDict) -> dict[str, float]:
    """PSNR of open-loop imagination at some horizons, on all and on moving pixels, beside copying the first frame."""
    imagined = imagine_episodes(model, episodes, ForwardKinematics())["frames"]  # [R, T+1, 3, H, W]
    figures: dict[str, float] = {}
    for horizon in (horizon for horizon in HORIZONS if horizon < imagined.shape[1]):
        alive = (episodes["length"].squeeze(-1) >= horizon).nonzero().squeeze(-1)
        if not len(alive):
            continue
        real, first = episodes["frames"][alive, horizon], episodes["frames"][alive, 0]
        for name, guess in (("model", imagined[alive, horizon]), ("copy", first)):
            figures[f"psnr_{name}_{horizon}"] = psnr(guess, real).clamp(max=60).mean().item()
            figures[f"moving_psnr_{name}_{horizon}"] = moving_pixel_psnr(guess, real, first).nanmean().item()
    return figures


if __name__ == "__main__":
    from world_env import run_single

    run_single("train_world_model")
