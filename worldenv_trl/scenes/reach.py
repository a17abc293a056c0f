"""Where the hand can be while it points straight down, as the expert holds it."""

from __future__ import annotations

import math

import numpy as np

from worldenv_trl.robot import panda

__all__ = ["out_of_reach"]

_SHOULDER = panda.JOINTS[0].xyz[2]
# Shoulder to elbow and elbow to wrist; the elbow's axis lies beside the arm.
_ARM = math.hypot(panda.JOINTS[2].xyz[1], panda.JOINTS[3].xyz[0]) + math.hypot(*panda.JOINTS[4].xyz[:2])
_WRIST = panda.JOINTS[6].xyz[0]  # the flange is at most so much further out than the wrist


def out_of_reach(points: np.ndarray) -> np.ndarray:
    """How far points ``[n, 3]`` are (m, at least) from where the tip of a hand that points down can be, ``[n]``.

    Zero within the bounds of commanded positions and the length of the stretched arm. What is closer than the folded
    arm, and the ranges of single joints, are left out: a point at zero may yet be out of reach.
    """
    box = np.maximum(np.maximum(panda.WORKSPACE_LOW - points, points - panda.WORKSPACE_HIGH), 0.0)
    x, y, z = (points - np.array(panda.BASE_POSITION)).T
    wrist = np.hypot(np.maximum(np.hypot(x, y) - _WRIST, 0.0), z + panda.TCP_OFFSET - _SHOULDER)
    return np.maximum(np.linalg.norm(box, axis=-1), np.maximum(wrist - _ARM, 0.0))
