"""Losses as TorchRL ``LossModule``s."""

from __future__ import annotations

from worldenv_trl.objectives.diffusion import DiffusionLoss

__all__ = ["DiffusionLoss"]
