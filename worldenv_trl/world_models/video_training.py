"""Training loss of the video world model: flow matching with x-prediction, partly on the model's own frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.keys import frames_key
from worldenv_trl.language import instructions_of
from worldenv_trl.row_share import own_rows
from worldenv_trl.world_models.base import POSES, request
from worldenv_trl.world_models.cells import from_cells, to_cells, to_float, to_uint8
from worldenv_trl.world_models.flow_matching import add_noise
from worldenv_trl.world_models.window import Window

if TYPE_CHECKING:
    from worldenv_trl.world_models.video_world_model import VideoWorldModel

__all__ = ["video_loss"]

_MOVING = int(255 * 0.05)  # difference of intensity from which a pixel counts as moving


def video_loss(model: VideoWorldModel, windows: TensorDictBase) -> TensorDict:
    """Regresses the clean frames of ``n`` consecutive chunks; later chunks remember the model's own frames.

    Chunk 1 of a window remembers real frames. Every later chunk of a row remembers, with probability ``unroll_prob``,
    what the model itself just painted (detached and quantised, as in imagination), otherwise the real frames. So no
    forward pass is spent on unrolling alone.

    Error per pixel: ``(x - x_0)^2 + l1_weight * |x - x_0|`` with images in [-1, 1], averaged with weight
    ``1 + moving_weight`` on moving pixels (where the target differs from the reference or the last real frame) and 1
    elsewhere.

    With probability ``noise_prob`` a row is trained as a flow-matching sample (noise level uniform in [0, 1)),
    otherwise from zero noise at level 0, the deterministic one-step mode. When a model will only be used
    deterministically, 0 spends everything on that mode.

    Args:
        model: its config holds the settings.
        windows: [B], see :class:`~worldenv_trl.world_models.Window`.

    Returns:
        ``loss_world_model`` (scalar), and the detached ``mse`` and ``moving_mse`` (of images in [0, 1]) of the rows
        without noise, and ``weight``, that of all pixels, over which the loss is a mean.

    Raises:
        ValueError: for a window that is not a whole number of chunks.
    """
    config, length = model.config, model.chunk_length
    window, texts = Window(windows), instructions_of(windows)
    if window.steps == 0 or window.steps % length:
        raise ValueError(f"a window must hold whole chunks of {length} frames, got {window.steps} steps")
    noise_prob = config.noise_prob
    if noise_prob is None:
        noise_prob = 0.0 if model.deterministic else 0.5
    count, device = len(windows), window.start.device
    noised = _uniform(count, device) < noise_prob
    shown = window  # what the next chunk remembers: real frames, or the model's own
    reference = _stacked(model, window.recall(torch.zeros(count, 1, dtype=torch.int64, device=device)))
    total = weight = torch.zeros((), device=device)
    sums = torch.zeros(4, device=device)
    for chunk in range(window.steps // length):
        now, offset = window.start + chunk * length, torch.arange(1, length + 1, device=device)
        targets = window.recall(now.unsqueeze(-1) + offset)
        steps = slice(chunk * length, (chunk + 1) * length)
        asked = request(model, shown.recall, now, targets[POSES], window.actions[:, steps], texts)
        cells = _stacked(model, targets)  # [B, V, C, 3, P, h, w], the model's layout
        clean = to_float(cells)
        level = _uniform(count, device) * noised
        noisy = None
        if noise_prob:
            noisy = add_noise(clean, _normal_like(clean), level) * noised.view(-1, 1, 1, 1, 1, 1, 1)
        predicted = model.predict(noisy, level, model.conditions(asked, texts))

        last = _stacked(model, window.recall(now.unsqueeze(-1)))
        moving = _moving(cells, reference, last)  # [B, V, C, 1, P, h, w]
        valid = window.mask[:, steps]
        pixel_weight = (1 + config.moving_weight * moving) * valid.view(count, 1, length, 1, 1, 1, 1)
        error = predicted - clean
        absolute = error.abs()
        total = total + (absolute * (absolute + config.l1_weight) * pixel_weight).sum() / 3
        weight = weight + pixel_weight.sum()
        with torch.no_grad():
            sums += _squares(error, moving, valid & ~noised.unsqueeze(-1))

        if (chunk + 1) * length < window.steps:
            painted = from_cells(to_uint8(predicted.detach()), config.patch)  # as imagination would store them
            own = _uniform(count, device) < config.unroll_prob
            # A prediction from an almost clean chunk is not what the model would imagine.
            own = own & (level < 0.5)
            frames = {frames_key(camera): painted[:, index] for index, camera in enumerate(model.cameras)}
            shown = window.with_own(own, now.unsqueeze(-1) + offset, frames, shown)
    return TensorDict(
        {
            "loss_world_model": total / weight.clamp(min=1.0),
            "mse": sums[0] / sums[1].clamp(min=1.0),
            "moving_mse": sums[2] / sums[3].clamp(min=1.0),
            "weight": weight.detach(),
        }
    )


def _uniform(count: int, device: torch.device) -> Tensor:
    return own_rows(lambda rows: torch.rand(rows, device=device), count)


def _normal_like(clean: Tensor) -> Tensor:
    return own_rows(lambda rows: torch.randn(rows, *clean.shape[1:], device=clean.device), len(clean))


def _stacked(model: VideoWorldModel, frames: TensorDictBase) -> Tensor:
    """Frames [B, K] of all cameras as uint8 cells [B, V, K, 3, P, h, w]."""
    views = [to_cells(frames[frames_key(camera)], model.config.patch) for camera in model.cameras]
    return views[0].unsqueeze(1) if len(views) == 1 else torch.stack(views, 1)


def _moving(chunk: Tensor, reference: Tensor, last: Tensor) -> Tensor:
    """1 where a pixel of the chunk differs from the reference or the last frame before it: [B, V, C, 1, P, h, w]."""
    chunk = chunk.short()
    changed = (chunk - reference.short()).abs() > _MOVING
    changed |= (chunk - last.short()).abs() > _MOVING
    return changed.any(3, keepdim=True).float()


def _squares(error: Tensor, moving: Tensor, valid: Tensor) -> Tensor:
    """Squared error in [0, 1] units and pixel count, of all pixels and of moving ones: [4]."""
    square = error.square().mean(3, keepdim=True) / 4
    shape = (len(valid), 1, valid.shape[1], 1, 1, 1, 1)
    valid = valid.view(shape).float().expand_as(square)
    moving = moving * valid
    return torch.stack([(square * valid).sum(), valid.sum(), (square * moving).sum(), moving.sum()])
