"""Losses as TorchRL ``LossModule``s, and the leave-one-out advantage."""

from __future__ import annotations

from worldenv_trl.objectives.diffusion import DiffusionLoss
from worldenv_trl.objectives.loop import LOOPLoss
from worldenv_trl.objectives.reflector import ReflectorLoss
from worldenv_trl.objectives.rloo import rloo_advantage

__all__ = ["DiffusionLoss", "LOOPLoss", "ReflectorLoss", "rloo_advantage"]
