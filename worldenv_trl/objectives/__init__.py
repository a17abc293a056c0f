"""Losses as TorchRL ``LossModule``s, and the leave-one-out advantage."""

from __future__ import annotations

from worldenv_trl.objectives.aimed_cloning import AimedCloning
from worldenv_trl.objectives.distillation import DistillationLoss
from worldenv_trl.objectives.loop import LOOPLoss
from worldenv_trl.objectives.reflector import ReflectorLoss
from worldenv_trl.objectives.rloo import rloo_advantage
from worldenv_trl.objectives.world_model import WorldModelLoss

__all__ = [
    "AimedCloning",
    "DistillationLoss",
    "LOOPLoss",
    "ReflectorLoss",
    "WorldModelLoss",
    "rloo_advantage",
]
