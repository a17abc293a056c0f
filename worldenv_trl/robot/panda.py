"""The Franka Emika Panda: published kinematics, limits and link inertias, and the rule that moves it. NumPy only.

Joint frames, limits and the hand follow Franka's public robot description; link inertias are the identified values of
Gaz et al., "Dynamic Identification of the Franka Emika Panda Robot", RA-L 2019. Metres, radians, kilograms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Joint:
    """One revolute joint, about its own z axis, and the link it carries.

    ``xyz`` and ``rpy`` place the joint frame in the parent's; ``com`` and ``inertia`` (xx yy zz xy xz yz about the
    centre of mass) are in the joint frame.
    """

    name: str
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    lower: float
    upper: float
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]


_H = math.pi / 2
JOINTS: tuple[Joint, ...] = (
    Joint("joint1", (0, 0, 0.333), (0, 0, 0), -2.8973, 2.8973, 4.970684, (0.003875, 0.002081, -0.04762),
          (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    Joint("joint2", (0, 0, 0), (-_H, 0, 0), -1.7628, 1.7628, 0.646926, (-0.003141, -0.02872, 0.003495),
          (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    Joint("joint3", (0, -0.316, 0), (_H, 0, 0), -2.8973, 2.8973, 3.228604, (0.027518, 0.039252, -0.066502),
          (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    Joint("joint4", (0.0825, 0, 0), (_H, 0, 0), -3.0718, -0.0698, 3.587895, (-0.05317, 0.104419, 0.027454),
          (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    Joint("joint5", (-0.0825, 0.384, 0), (-_H, 0, 0), -2.8973, 2.8973, 1.225946, (-0.011953, 0.041065, -0.038437),
          (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    Joint("joint6", (0, 0, 0), (_H, 0, 0), -0.0175, 3.7525, 1.666555, (0.060149, -0.014117, -0.010517),
          (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    Joint("joint7", (0.088, 0, 0), (_H, 0, 0), -2.8973, 2.8973, 0.735522, (0.010517, -0.004252, 0.061597),
          (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
)  # fmt: skip
JOINT_LOW = np.array([joint.lower for joint in JOINTS])
JOINT_HIGH = np.array([joint.upper for joint in JOINTS])

BASE_POSITION = (-0.6, 0.0, 0.0)  # the table top is z = 0
HAND_OFFSET = 0.107  # flange along the z axis of joint 7
HAND_YAW = -math.pi / 4
TCP_FROM_HAND = 0.1034  # between the fingertips
TCP_OFFSET = HAND_OFFSET + TCP_FROM_HAND
HOME_Q = np.array([0.0, -0.184833, 0.0, -2.496740, 0.0, 2.311907, math.pi / 4])  # the hand points straight down
WORKSPACE_LOW = np.array([-0.25, -0.35, 0.005])  # bounds of the commanded tcp position
WORKSPACE_HIGH = np.array([0.30, 0.35, 0.45])
FINGER_TRAVEL = 0.04  # each finger; the opening 1 is 0.08 m wide
GRIPPER_RATE = 0.2  # change of the commanded opening per control step
DLS_DAMPING = 0.02
MAX_JOINT_STEP = 0.2  # rad per control step; without it a target out of reach makes the arm swing


def urdf() -> str:
    """The arm from ``world`` to the link ``tcp`` as URDF text, for kinematics libraries that read it."""
    links = ["world", "base", *(f"link{i}" for i in range(1, 8)), "tcp"]
    text = ['<robot name="panda">', *(f'<link name="{name}"/>' for name in links)]
    text.append(_urdf_joint("base_mount", "fixed", "world", "base", BASE_POSITION, (0, 0, 0)))
    for parent, child, joint in zip(links[1:], links[2:-1], JOINTS, strict=False):
        limit = f'<axis xyz="0 0 1"/><limit lower="{joint.lower}" upper="{joint.upper}" effort="87" velocity="2.6"/>'
        text.append(_urdf_joint(joint.name, "revolute", parent, child, joint.xyz, joint.rpy, limit))
    text.append(_urdf_joint("tcp_mount", "fixed", "link7", "tcp", (0, 0, TCP_OFFSET), (0, 0, HAND_YAW)))
    return "\n".join([*text, "</robot>"])


def _urdf_joint(
    name: str, kind: str, parent: str, child: str, xyz: Sequence[float], rpy: Sequence[float], extra: str = ""
) -> str:
    pose = f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{pose}{extra}</joint>'


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
