"""Training loss of the full-size world model: the error of v on the chunk's latents."""

from __future__ import annotations

from dataclasses import replace
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

__all__ = ["denoising_loss", "diffusion_loss"]


def diffusion_loss(model: DiffusionWorldModel, windows: TensorDictBase) -> TensorDict:
    """Mean squared error of v of one chunk of each window, at a timestep of each row's own.

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
    """The same of a chunk's latents.

    Args:
        model: its network is trained.
        clean: [B, C, z, h, w].
        conditions: of the chunk.
        valid: bool [B, C], frames that count.
    """
    count, device = len(clean), clean.device
    disturbed = torch.rand(count, device=device) * model.config.memory_noise
    memory = conditions.memory + disturbed.view(-1, 1, 1, 1, 1) * torch.randn_like(conditions.memory)
    conditions = replace(conditions, memory=memory)
    noise, timesteps = torch.randn_like(clean), torch.randint(TRAIN_STEPS, (count,), device=device)
    noisy = model.scheduler.add_noise(clean, noise, timesteps)
    predicted = model.predict_v(noisy, timesteps, conditions, disturbed)
    wanted = model.scheduler.get_velocity(clean, noise, timesteps)

    weight = valid.float()
    total = weight.sum().clamp(min=1)

    def mean(square: Tensor) -> Tensor:
        return (square.mean((-3, -2, -1)) * weight).sum() / total

    square = (predicted - wanted).square()
    # x_0 = sqrt(a) x - sqrt(1 - a) v: an error of v is one of x_0, times the level of noise.
    level = 1 - model.scheduler.alphas_cumprod.to(device)[timesteps].view(-1, 1, 1, 1, 1)
    return TensorDict({"loss_world_model": mean(square), "latent_mse": mean(level * square.detach())})
