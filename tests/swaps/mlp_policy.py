"""A policy that shares nothing with the compact one: no tokens, no attention, no adapters, and goals by name."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import nn

from worldenv_trl.policies import Policy
from worldenv_trl.pretrained import Pretrained


@dataclass(frozen=True)
class MLPConfig:
    instructions: tuple[str, ...]
    cameras: tuple[str, ...] = ("agentview",)
    image_size: int = 64
    chunk_length: int = 8
    proprio: str = "commanded"
    dim: int = 64


class MLPPolicy(Policy, Pretrained):
    """Sees the mean colour of each quadrant of its images; an instruction that it never saw is another one to it."""

    config_class = MLPConfig

    def __init__(self, config: MLPConfig) -> None:
        super().__init__(
            cameras=config.cameras,
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            proprio=config.proprio,
            instructions=config.instructions,
        )
        self.config = config
        self.goals = nn.Embedding(len(config.instructions) + 1, config.dim)
        self.trunk = nn.Sequential(nn.Linear(12 * len(config.cameras) + 7 + config.dim, config.dim), nn.Tanh())
        self.loc, self.log_scale = (nn.Linear(config.dim, config.chunk_length * 7) for _ in range(2))
        nn.init.constant_(self.log_scale.bias, -3.0)

    def predict(self, images, state, instructions):
        known = {text: row for row, text in enumerate(self.instructions)}
        rows = torch.tensor([known.get(text, len(known)) for text in instructions], dtype=torch.int64)
        colours = [nn.functional.adaptive_avg_pool2d(images[camera] / 255, 2).flatten(1) for camera in self.cameras]
        hidden = self.trunk(torch.cat([*colours, state, self.goals(rows)], -1))
        return tuple(head(hidden).unflatten(-1, (self.chunk_length, 7)) for head in (self.loc, self.log_scale))

    def fit_statistics(self, states, actions):
        self.action_range.copy_(actions.flatten(0, -2).abs().amax(0).clamp(min=0.005))

    def scale_parameters(self):
        return self.log_scale.parameters()

    def post_training_parameters(self, rank):
        self.requires_grad_(False)
        heads = list(itertools.chain(self.loc.parameters(), self.log_scale.parameters()))
        for parameter in heads:
            parameter.requires_grad_(True)
        return {"adapters": [], "heads": heads}
