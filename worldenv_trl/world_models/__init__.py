"""Imagination: a video world model conditioned on where forward kinematics says the hand goes."""

from __future__ import annotations

from worldenv_trl.world_models.base import WorldModel, memory_key, paint, reference_key, request
from worldenv_trl.world_models.diffusion_config import DiffusionWorldModelConfig
from worldenv_trl.world_models.diffusion_weights import load_diffusers
from worldenv_trl.world_models.diffusion_world_model import DiffusionWorldModel
from worldenv_trl.world_models.video_world_model import VideoWorldModel, VideoWorldModelConfig
from worldenv_trl.world_models.window import Window

__all__ = [
    "DiffusionWorldModel",
    "DiffusionWorldModelConfig",
    "VideoWorldModel",
    "VideoWorldModelConfig",
    "Window",
    "WorldModel",
    "load_diffusers",
    "memory_key",
    "paint",
    "reference_key",
    "request",
]
