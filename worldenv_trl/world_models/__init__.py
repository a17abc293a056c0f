"""Imagination: a video world model conditioned on where forward kinematics says the hand goes."""

from __future__ import annotations

from worldenv_trl.world_models.denoiser import Denoiser
from worldenv_trl.world_models.video_world_model import VideoWorldModel, VideoWorldModelConfig

__all__ = ["Denoiser", "VideoWorldModel", "VideoWorldModelConfig"]
