"""Losses as TorchRL ``LossModule``s, and advantages: leave-one-out, or over a learned baseline."""

from __future__ import annotations

from worldenv_trl.objectives.aimed_cloning import AimedCloning
from worldenv_trl.objectives.loop import LOOPLoss
from worldenv_trl.objectives.reflector import ReflectorLoss
from worldenv_trl.objectives.rloo import rloo_advantage
from worldenv_trl.objectives.value_baseline import ValueBaseline, baseline_advantage
from worldenv_trl.objectives.world_model import WorldModelLoss

__all__ = [
    "AimedCloning",
    "LOOPLoss",
    "ReflectorLoss",
    "ValueBaseline",
    "WorldModelLoss",
    "baseline_advantage",
    "rloo_advantage",
]
