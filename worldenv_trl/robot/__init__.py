"""What the arm is: geometry, cameras' mathematics, conventions. NumPy only: no MuJoCo, no GL."""

from worldenv_trl.robot.camera import WRIST, Camera, look_at

__all__ = ["WRIST", "Camera", "look_at"]
