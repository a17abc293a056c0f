"""Where the robot goes: forward kinematics of actions, and its projection on the camera image."""

from __future__ import annotations

from worldenv_trl.kinematics.action_map import ActionMap

__all__ = ["ActionMap"]
