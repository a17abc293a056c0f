"""Pose control of the arm: accumulated targets and one damped least-squares step per control step.

Adding an action to the *current* pose drifts by centimetres in a second; the targets here are accumulated instead.
NumPy, batched over rows; :class:`worldenv_trl.kinematics.ForwardKinematics` is the same rule in PyTorch.
"""

from __future__ import annotations

import math

import numpy as np

from worldenv_trl.keys import POSITION_STEP, ROTATION_STEP
from worldenv_trl.robot import panda


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


_FRAMES = [(np.array(joint.xyz, float), _rotation(*joint.rpy)) for joint in panda.JOINTS]
_TURN = np.array([1.0, -1.0])  # x turns towards y, y away from x
_TCP = (np.array([0.0, 0.0, panda.TCP_OFFSET]), _rotation(0.0, 0.0, panda.HAND_YAW))


def forward_kinematics(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose of ``tcp`` and its geometric Jacobian in world axes.

    Args:
        q: joint angles ``[n, 7]`` (rad).

    Returns:
        position ``[n, 3]`` (m), rotation ``[n, 3, 3]``, Jacobian ``[n, 6, 7]`` (linear rows first).
    """
    n = len(q)
    position = np.broadcast_to(np.array(panda.BASE_POSITION, float), (n, 3))
    rotation = np.broadcast_to(np.eye(3), (n, 3, 3))
    cosine, sine = np.cos(q)[:, :, None, None], np.sin(q)[:, :, None, None] * _TURN
    origins, axis = np.empty((n, len(_FRAMES), 3)), np.empty((n, len(_FRAMES), 3))
    for index, (offset, fixed) in enumerate(_FRAMES):
        if offset.any():
            position = position + rotation @ offset
        rotation = rotation @ fixed
        x_and_y = rotation[..., :2] * cosine[:, index] + rotation[..., 1::-1] * sine[:, index]
        rotation[..., :2] = x_and_y
        origins[:, index], axis[:, index] = position, rotation[..., 2]
    position = position + rotation @ _TCP[0]
    rotation = rotation @ _TCP[1]
    lever = position[:, None] - origins
    columns = np.empty((n, len(_FRAMES), 6))  # in this layout products keep their last bits, and runs replay
    for index, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        columns[..., index] = axis[..., i] * lever[..., j] - axis[..., j] * lever[..., i]
    columns[..., 3:] = axis
    return position, rotation, columns.swapaxes(1, 2)


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula: rotation vectors ``[n, 3]`` (rad) to matrices ``[n, 3, 3]``."""
    angle = np.linalg.norm(vector, axis=-1)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)[:, None, None]
    b = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)[:, None, None]
    k = np.zeros((len(vector), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vector[:, 2], vector[:, 1], -vector[:, 0]
    k -= k.swapaxes(1, 2)
    return np.eye(3) + a * k + b * (k @ k)


def vector_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Matrices ``[n, 3, 3]`` to rotation vectors ``[n, 3]`` (rad), angle in [0, pi]."""
    skew = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        -1,
    )
    sine = 0.5 * np.linalg.norm(skew, axis=-1)
    cosine = 0.5 * (np.trace(rotation, axis1=1, axis2=2) - 1)
    angle = np.arctan2(sine, cosine)
    vector = 0.5 * skew * np.where(sine < 1e-7, 1.0, angle / np.maximum(sine, 1e-12))[:, None]
    half_turn = (sine < 1e-6) & (cosine < 0)
    if half_turn.any():  # the skew part vanishes: the axis is the largest column of R + I
        symmetric = rotation[half_turn] + np.eye(3)
        column = np.argmax(np.diagonal(symmetric, axis1=1, axis2=2), -1)
        axis = symmetric[np.arange(len(symmetric)), :, column]
        vector[half_turn] = math.pi * axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    return vector


def hand_axis_angle(rotation: np.ndarray) -> np.ndarray:
    """Axis-angle ``[n, 3]`` (rad) of ``[n, 3, 3]``, continuous around a hand that points down.

    The hand works near a half turn about x, where the usual choice (angle at most pi) flips its sign for nothing; here
    the axis keeps a positive x component and the angle runs to 2 pi.
    """
    vector = vector_from_rotation(rotation)
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    other = vector * (1 - 2 * math.pi / np.maximum(angle, 1e-12))
    return np.where((vector[:, :1] < 0) & (angle > 1e-8), other, vector)


def reset_targets(q: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """Targets ``[n, 13]`` (x_des, R_des row-major, opening) that hold the arm where ``q`` puts it."""
    position, rotation, _ = forward_kinematics(q)
    return np.concatenate([position, rotation.reshape(len(q), 9), np.reshape(opening, (-1, 1))], -1)


def advance_targets(targets: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Adds one action ``[n, 7]``, clipped to [-1, 1], to the targets ``[n, 13]``."""
    action = np.clip(action, -1.0, 1.0)
    position = np.clip(targets[:, :3] + POSITION_STEP * action[:, :3], panda.WORKSPACE_LOW, panda.WORKSPACE_HIGH)
    turn = rotation_from_vector(ROTATION_STEP * action[:, 3:6])
    rotation = (turn @ targets[:, 3:12].reshape(-1, 3, 3)).reshape(-1, 9)
    opening = np.clip(targets[:, 12:] - panda.GRIPPER_RATE * np.sign(action[:, 6:]), 0.0, 1.0)
    return np.concatenate([position, rotation, opening], -1)


def joint_targets(q: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """One damped least-squares step from ``q`` ``[n, 7]`` to the target pose, inside the joint limits."""
    position, rotation, jacobian = forward_kinematics(q)
    desired = targets[:, 3:12].reshape(-1, 3, 3)
    error = np.concatenate([targets[:, :3] - position, vector_from_rotation(desired @ rotation.swapaxes(1, 2))], -1)
    damped = jacobian @ jacobian.swapaxes(1, 2) + panda.DLS_DAMPING**2 * np.eye(6)
    step = (jacobian.swapaxes(1, 2) @ np.linalg.solve(damped, error[..., None]))[..., 0]
    step *= np.minimum(1.0, panda.MAX_JOINT_STEP / np.maximum(np.abs(step).max(-1, keepdims=True), 1e-12))
    return np.clip(q + step, panda.JOINT_LOW, panda.JOINT_HIGH)
