"""Training loss of the video world model: flow matching with x-prediction, partly on the model's own frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives.common import LossModule

from worldenv_trl.keys import TASK_ID
from worldenv_trl.world_models.denoiser import from_cells, to_cells
from worldenv_trl.world_models.flow_matching import add_noise
from worldenv_trl.world_models.video_world_model import (
    MEMORY_FRAMES,
    MEMORY_POSES,
    PADDED_ACTIONS,
    POSES,
    REFERENCE,
    VideoWorldModel,
    to_float,
    to_uint8,
)

__all__ = ["DiffusionLoss"]


class DiffusionLoss(LossModule):
    """Regresses the clean frames of ``n`` consecutive chunks; later chunks remember the model's own frames.

    A sample is a window of an episode that starts at any frame t: the memory at t (frames
    ``o[world_model.memory_indices(t)]``), and ``n * C`` steps from there. Chunk 1 remembers real frames. Every later
    chunk of a row remembers, with probability ``unroll_prob``, what the model itself just painted (detached and
    quantised, as in imagination), otherwise the real frames. So no forward pass is spent on unrolling alone.

    Error per pixel: ``(x - x_0)^2 + l1_weight * |x - x_0|`` with images in [-1, 1], averaged with weight
    ``1 + moving_weight`` on moving pixels (where the target differs from the reference or the last real frame) and 1
    elsewhere.

    With probability ``noise_prob`` a row is trained as a flow-matching sample (noise level uniform in [0, 1)),
    otherwise from zero noise at level 0, the deterministic one-step mode. When a model will only be used
    deterministically, ``noise_prob=0`` spends everything on that mode.

    Reads, for B windows: ``("memory", "frames")`` uint8 [B, M, 3, H, W], ``("memory", "poses")`` [B, M, 13],
    ``("memory", "reference")`` uint8 [B, 3, H, W], ``poses`` [B, n C, 13], ``padded_actions`` [B, n C, 14],
    ``target_frames`` uint8 [B, n C, 3, H, W], ``target_mask`` bool [B, n C] (False past the end of the episode) and
    ``task_id`` [B, 1]. The memory of later chunks follows from the first one's.

    Returns a TensorDict with ``loss_diffusion`` (scalar) and the detached ``mse`` and ``moving_mse`` (of images in
    [0, 1]) of the rows without noise.

    Args:
        world_model: the model to train.

    Keyword Args:
        unroll_prob: share of later chunks that remember the model's own frames.
        noise_prob: share of rows trained at random noise levels; default: 0 for a deterministic model, else 0.5.
        l1_weight: weight of the absolute error.
        moving_weight: additional weight of moving pixels.
        frames_per_chunk: frames of each chunk that are painted and scored, drawn anew for every call (those that the
            next chunk remembers are always among them); None is all. Neighbouring frames teach much the same, and the
            decoder is a large part of the cost.
        moving_threshold: difference, as a fraction of the intensity range, from which a pixel counts as moving.

    Raises:
        ValueError: a window that is not a whole number of chunks, or a setting out of range.
    """

    @dataclass
    class _AcceptedKeys:
        target_frames: str = "target_frames"
        target_mask: str = "target_mask"

    default_keys = _AcceptedKeys
    world_model: VideoWorldModel
    out_keys: ClassVar[list[str]] = ["loss_diffusion", "mse", "moving_mse"]

    def __init__(
        self,
        world_model: VideoWorldModel,
        *,
        unroll_prob: float = 0.5,
        noise_prob: float | None = None,
        l1_weight: float = 0.15,
        moving_weight: float = 4.0,
        frames_per_chunk: int | None = None,
        moving_threshold: float = 0.05,
    ) -> None:
        super().__init__()
        if noise_prob is None:
            noise_prob = 0.0 if world_model.deterministic else 0.5
        for name, value in (("unroll_prob", unroll_prob), ("noise_prob", noise_prob)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must lie between 0 and 1, got {value}")
        if min(l1_weight, moving_weight) < 0:
            raise ValueError(f"l1_weight and moving_weight must not be negative, got {l1_weight} and {moving_weight}")
        if frames_per_chunk is not None and not 2 <= frames_per_chunk <= world_model.chunk_length:
            length = world_model.chunk_length
            raise ValueError(f"frames_per_chunk must lie between 2 and {length}, got {frames_per_chunk}")
        self.frames_per_chunk = frames_per_chunk
        # The module is trained in place: no functional copy of its parameters is made.
        self.world_model = world_model
        self.unroll_prob, self.noise_prob = float(unroll_prob), float(noise_prob)
        self.l1_weight, self.moving_weight = float(l1_weight), float(moving_weight)
        self.moving_threshold = float(moving_threshold)
        self.set_in_keys()

    def set_in_keys(self) -> None:
        self.in_keys = [
            MEMORY_FRAMES, MEMORY_POSES, REFERENCE, POSES, PADDED_ACTIONS, TASK_ID,
            self.tensor_keys.target_frames, self.tensor_keys.target_mask,
        ]  # fmt: skip

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        self.set_in_keys()

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        model, length = self.world_model, self.world_model.chunk_length
        targets, mask = tensordict[self.tensor_keys.target_frames], tensordict[self.tensor_keys.target_mask]
        if targets.shape[1] == 0 or targets.shape[1] % length:
            raise ValueError(f"target_frames must hold whole chunks of {length} frames, got {targets.shape[1]}")
        noised = torch.rand(targets.shape[0], device=targets.device) < self.noise_prob
        memory = real_memory = tensordict[MEMORY_FRAMES]
        memory_poses, patch = tensordict[MEMORY_POSES], model.config.patch
        reference = to_cells(tensordict[REFERENCE], patch)
        total = weight = 0.0
        sums = torch.zeros(4, device=targets.device)
        for start in range(0, targets.shape[1], length):
            steps = slice(start, start + length)
            chunk, valid = targets[:, steps], mask[:, steps]
            inputs = TensorDict(
                {
                    "memory": {"frames": memory, "poses": memory_poses, "reference": tensordict[REFERENCE]},
                    POSES: tensordict[POSES][:, steps],
                    PADDED_ACTIONS: tensordict[PADDED_ACTIONS][:, steps],
                    TASK_ID: tensordict[TASK_ID],
                },
                batch_size=targets.shape[:1],
            )
            last_chunk = start + length == targets.shape[1]
            frames = self._draw_frames(last_chunk, targets.device)
            cells = to_cells(chunk, patch)  # [B, C, 3, P, h, w], the model's layout
            clean = to_float(cells if self.noise_prob or frames is None else cells[:, frames])
            level = torch.rand(targets.shape[0], device=targets.device) * noised
            noisy = None
            if self.noise_prob:
                noisy = add_noise(clean, torch.randn_like(clean), level) * noised.view(-1, 1, 1, 1, 1, 1)
            predicted = model.predict(noisy, level, model.conditions(inputs), frames)
            if frames is not None:
                cells, valid = cells[:, frames], valid[:, frames]
                clean = clean[:, frames] if self.noise_prob else clean

            moving = self._moving(cells, reference, to_cells(real_memory[:, -1], patch))  # [B, C, 1, P, h, w]
            pixel_weight = (1 + self.moving_weight * moving) * valid.view(*valid.shape, 1, 1, 1, 1)
            error = predicted - clean
            absolute = error.abs()
            total = total + (absolute * (absolute + self.l1_weight) * pixel_weight).sum() / 3
            weight = weight + pixel_weight.sum()
            with torch.no_grad():
                sums += self._squares(error, moving, valid & ~noised.unsqueeze(-1))

            if not last_chunk:
                painted = _painted(predicted, patch)
                if frames is not None:  # only frames that were painted are remembered
                    painted = torch.zeros_like(chunk).index_copy_(1, frames, painted)
                real_memory = model.next_memory(real_memory, chunk)
                own_memory = model.next_memory(memory, painted)
                own = torch.rand(targets.shape[0], device=targets.device) < self.unroll_prob
                # A prediction from an almost clean chunk is not what the model would imagine.
                own = own & (level < 0.5)
                memory = torch.where(own.view(-1, 1, 1, 1, 1), own_memory, real_memory)
                memory_poses = model.next_memory(memory_poses, inputs[POSES])
        return TensorDict(
            {
                "loss_diffusion": total / weight.clamp(min=1.0),
                "mse": sums[0] / sums[1].clamp(min=1.0),
                "moving_mse": sums[2] / sums[3].clamp(min=1.0),
            }
        )

    def _draw_frames(self, last_chunk: bool, device: torch.device) -> Tensor | None:
        length = self.world_model.chunk_length
        if self.frames_per_chunk in (None, length):
            return None
        order = torch.rand(length)
        if not last_chunk:  # the next chunk's memory: see VideoWorldModel.next_memory
            order[[length - 1, max(length - 1 - self.world_model.config.memory_stride, 0)]] = -1.0
        return order.argsort()[: self.frames_per_chunk].sort().values.to(device)

    def _moving(self, chunk: Tensor, reference: Tensor, last: Tensor) -> Tensor:
        """1 where a pixel of the chunk differs from the reference or the last frame before it: [B, C, 1, P, h, w]."""
        chunk, threshold = chunk.short(), int(255 * self.moving_threshold)
        changed = (chunk - reference.short().unsqueeze(1)).abs() > threshold
        changed |= (chunk - last.short().unsqueeze(1)).abs() > threshold
        return changed.any(2, keepdim=True).float()

    @staticmethod
    def _squares(error: Tensor, moving: Tensor, valid: Tensor) -> Tensor:
        """Squared error in [0, 1] units and pixel count, of all pixels and of moving ones: [4]."""
        square = error.square().mean(2, keepdim=True) / 4
        valid = valid.view(*valid.shape, 1, 1, 1, 1).float().expand_as(square)
        moving = moving * valid
        return torch.stack([(square * valid).sum(), valid.sum(), (square * moving).sum(), moving.sum()])


def _painted(cells: Tensor, patch: int) -> Tensor:
    """The frames that a prediction shows, as imagination would store them: uint8 [B, C, 3, H, W]."""
    return from_cells(to_uint8(cells.detach()), patch)
