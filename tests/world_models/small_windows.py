"""Training windows over whole short videos, in which everything is where its number says."""

from __future__ import annotations

import torch
from small_models import FRONT, PULL, PUSH
from tensordict import NonTensorStack, TensorDict

from worldenv_trl.keys import frames_key
from worldenv_trl.kinematics import ActionMap
from worldenv_trl.world_models import WorldModel


def make_windows(model: WorldModel, starts: tuple[int, ...] = (0, 5), chunks: int = 2) -> TensorDict:
    """Windows [B]: a bright square follows the tool over a dark gradient, on every camera's image.

    A window holds all frames of its video, so that place and number are the same.
    """
    rows, length = len(starts), max(starts) + chunks * model.chunk_length + 1
    generator = torch.Generator().manual_seed(1)
    poses = torch.zeros(rows, length, 13)
    poses[..., 1] = torch.linspace(-0.2, 0.2, length) * (1 + torch.rand(rows, 1, generator=generator))
    poses[..., 3:12] = torch.eye(3).flatten()
    axis, frames = torch.arange(32), {}
    for index, camera in enumerate(model.cameras):
        pixels = ActionMap(FRONT, 32).project(poses[..., :3]) + 4 * index
        inside = (axis - pixels[..., :1]).abs().le(3).unsqueeze(-2) & (axis - pixels[..., 1:]).abs().le(3).unsqueeze(-1)
        video = torch.where(inside.unsqueeze(2), 220 - 30 * index, axis.view(1, 1, 1, 1, 32) * 3)
        frames[frames_key(camera)] = video.expand(rows, length, 3, 32, 32).to(torch.uint8).contiguous()
    steps = chunks * model.chunk_length
    windows = TensorDict(
        {
            **frames,
            "poses": poses,
            "number": torch.arange(length).expand(rows, -1).contiguous(),
            "start": torch.tensor(starts).unsqueeze(-1),
            "actions": torch.rand(rows, steps, 7, generator=generator) * 2 - 1,
            "step_mask": torch.ones(rows, steps, dtype=torch.bool),
        },
        batch_size=[rows],
    )
    windows.set("language_instruction", NonTensorStack(*[(PULL, PUSH)[row % 2] for row in range(rows)]))
    return windows
