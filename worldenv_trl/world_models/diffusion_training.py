"""Training loss of the full-size world model: the error of v on the chunk's latents."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.keys import frames_key
from worldenv_trl.language import instructions_of
from worldenv_trl.world_models.base import POSES, request
from worldenv_trl.world_models.cells import to_float
from worldenv_trl.world_models.diffusion_process import TRAIN_STEPS
from worldenv_trl.world_models.window import Window

if TYPE_CHECKING:
    from worldenv_trl.world_models.diffusion_world_model import Conditions, DiffusionWorldModel

Predict = Callable[[Tensor, Tensor], Tensor]
"""Noisy latents [B, C, z, h, w] and timesteps int64 [B] -> v."""

__all__ = ["consistency_errors", "denoising_loss", "diffusion_loss", "v_errors"]


def diffusion_loss(model: DiffusionWorldModel, windows: TensorDictBase) -> TensorDict:
    """Mean squared error of v, or of jumps, of one chunk of each window, at a timestep of each row's own.

    Which of a window's chunks is learned is drawn for the whole batch. It remembers real frames, whose latents are
    disturbed by noise of a standard deviation of up to ``memory_noise`` (uniform, the network is told): in imagination
    they are the model's own, and not quite right. Steps past an episode's end do not count.

    Args:
        model: its config holds the settings.
        windows: [B], see :class:`~worldenv_trl.world_models.Window`.

    Returns:
        ``loss_world_model`` (scalar) and the detached ``latent_mse``, the error of the clean latents it implies.

    Raises:
        ValueError: for a window that is not a whole number of chunks.
    """
    window, texts, length = Window(windows), instructions_of(windows), model.chunk_length
    if window.steps == 0 or window.steps % length:
        raise ValueError(f"a window must hold whole chunks of {length} frames, got {window.steps} steps")
    chunk, device = int(torch.randint(window.steps // length, ())), window.start.device
    now, steps = window.start + chunk * length, slice(chunk * length, (chunk + 1) * length)
    targets = window.recall(now.unsqueeze(-1) + torch.arange(1, length + 1, device=device))
    asked = request(model, window.recall, now, targets[POSES], window.actions[:, steps], texts)
    clean = torch.cat([model.encode(to_float(targets[frames_key(camera)])) for camera in model.cameras], -2)
    return denoising_loss(model, clean, model.conditions(asked, texts), window.mask[:, steps])


def denoising_loss(model: DiffusionWorldModel, clean: Tensor, conditions: Conditions, valid: Tensor) -> TensorDict:
    """The same of a chunk's latents; with ``consistency_steps``, of :func:`consistency_errors`.

    Args:
        model: its network is trained.
        clean: [B, C, z, h, w].
        conditions: of the chunk.
        valid: bool [B, C], frames that count.
    """
    disturbed = torch.rand(len(clean), device=clean.device) * model.config.memory_noise
    memory = conditions.memory + disturbed.view(-1, 1, 1, 1, 1) * torch.randn_like(conditions.memory)
    predict = partial(model.predict_v, conditions=replace(conditions, memory=memory), memory_noise=disturbed)
    errors = v_errors if model.config.consistency_steps is None else consistency_errors
    error, latent_error = errors(model, predict, clean)
    weight = valid.float()

    def mean(square: Tensor) -> Tensor:
        return (square.mean((-3, -2, -1)) * weight).sum() / weight.sum().clamp(min=1)

    loss, latent = mean(error.square()), mean(latent_error.detach().square())
    return TensorDict({"loss_world_model": loss, "latent_mse": latent})


def v_errors(model: DiffusionWorldModel, predict: Predict, clean: Tensor) -> tuple[Tensor, Tensor]:
    """Of v at a timestep of each row's own, and of the clean latents that it implies: [B, C, z, h, w] each."""
    noise, timesteps = torch.randn_like(clean), torch.randint(TRAIN_STEPS, (len(clean),), device=clean.device)
    noisy = model.scheduler.add_noise(clean, noise, timesteps)
    error = predict(noisy, timesteps) - model.scheduler.get_velocity(clean, noise, timesteps)
    # x_0 = sqrt(a) x - sqrt(1 - a) v: an error of v is one of x_0, times the level of noise.
    return error, (1 - _signal(model, timesteps)).sqrt() * error


def consistency_errors(model: DiffusionWorldModel, predict: Predict, clean: Tensor) -> tuple[Tensor, Tensor]:
    """How far a jump to the clean end lands from the jump of the next step, and from the clean latents themselves.

    Consistency training (Song et al. 2023): of ``consistency_steps`` steps from pure noise to the clean end each row
    draws one. From there and from its next, less noisy step, with the same noise, the network should arrive at one
    place; the next step's is held fixed, and that of the last step is the clean end. What v-prediction averages, one
    jump then chooses from.
    """
    steps, count = model.config.consistency_steps or 1, len(clean)
    noise, number = torch.randn_like(clean), torch.randint(steps, (count,), device=clean.device)

    def jump(number: Tensor) -> Tensor:
        timesteps = (TRAIN_STEPS * (steps - number).clamp(min=1) / steps).round().long() - 1
        signal = _signal(model, timesteps)
        noisy = signal.sqrt() * clean + (1 - signal).sqrt() * noise
        return signal.sqrt() * noisy - (1 - signal).sqrt() * predict(noisy, timesteps)

    here = jump(number)
    with torch.no_grad():
        last = (number + 1 == steps).view(-1, 1, 1, 1, 1)
        there = torch.where(last, clean, jump(number + 1))
    return here - there, here - clean


def _signal(model: DiffusionWorldModel, timesteps: Tensor) -> Tensor:
    """alpha-bar [B, 1, 1, 1, 1]."""
    return model.scheduler.alphas_cumprod.to(timesteps.device)[timesteps].view(-1, 1, 1, 1, 1)
