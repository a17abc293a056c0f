"""Proprioception in the formats that policies were trained with."""

from __future__ import annotations

import torch
from torch import Tensor

from worldenv_trl.robot.panda import FINGER_TRAVEL

__all__ = ["libero_proprio"]


def libero_proprio(state: Tensor) -> Tensor:
    """LIBERO's 8 numbers of a state [..., 7]: the gripper's opening as the positions of its two fingers (m).

    Examples:
        >>> libero_proprio(torch.tensor([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 0.5]))[6:]
        tensor([ 0.0200, -0.0200])
    """
    finger = FINGER_TRAVEL * state[..., -1:]
    return torch.cat([state[..., :-1], finger, -finger], -1)
