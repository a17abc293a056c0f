"""Where the robot goes: forward kinematics of actions, and its projection on the camera image."""

from __future__ import annotations

from worldenv_trl.kinematics.action_map import ActionMap
from worldenv_trl.kinematics.forward import ForwardKinematics

__all__ = ["ActionMap", "ForwardKinematics"]
