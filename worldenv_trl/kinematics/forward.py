"""FK(s, a) -> s': where the hand goes, without physics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import pytorch_kinematics as pk
import torch
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM, KINEMATIC_DIM, POSITION_STEP, ROTATION_STEP
from worldenv_trl.robot import panda

__all__ = ["ForwardKinematics"]


class ForwardKinematics(nn.Module):
    """The arm's response to actions (World-Env section 3.2: s' = FK(s, a)), in joint space.

    The kinematic state [*B, 20] is ``q (7), x_des (3), R_des (9, row-major), commanded gripper opening (1)``. An action
    moves the accumulated target pose; one damped-least-squares step takes the joints towards it and stops at their
    limits. That is the rule the simulated controller follows, so open-loop predictions stay within millimetres of the
    physics over a whole episode; adding the action to the current pose instead drifts by centimetres.

    Everything is batched, differentiable (through the joints, the target and the six pose dimensions of the action; the
    gripper command is a sign) and runs where its input is, on CPU or GPU.

    Keyword Args:
        damping: damping of the least squares; default: the simulated controller's.

    Examples:
        >>> fk = ForwardKinematics()
        >>> state = fk.initial_state(torch.zeros(2, 7))
        >>> fk(state, torch.zeros(2, 7)).shape, fk.rollout(state, torch.zeros(2, 8, 7)).shape
        (torch.Size([2, 20]), torch.Size([2, 8, 20]))
    """

    _joint_low: Tensor
    _joint_high: Tensor
    _workspace_low: Tensor
    _workspace_high: Tensor
    _damping: Tensor

    def __init__(self, *, damping: float = panda.DLS_DAMPING) -> None:
        super().__init__()
        chain = pk.build_chain_from_urdf(panda.urdf().encode())
        self._chain = pk.SerialChain(chain, "tcp", dtype=torch.float32)
        self.damping = float(damping)
        for name, values in (
            ("_joint_low", panda.JOINT_LOW),
            ("_joint_high", panda.JOINT_HIGH),
            ("_workspace_low", panda.WORKSPACE_LOW),
            ("_workspace_high", panda.WORKSPACE_HIGH),
        ):
            self.register_buffer(name, torch.as_tensor(values, dtype=torch.float32), persistent=False)
        self.register_buffer("_damping", self.damping**2 * torch.eye(6), persistent=False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # the chain is not a module: move it along
        self._chain = self._chain.to(dtype=self._joint_low.dtype, device=self._joint_low.device)
        return self

    def _tcp(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Pose [n, 4, 4] of the tool centre and geometric Jacobian [n, 6, 7] in world axes."""
        jacobian, pose = self._chain.jacobian_tensor(q, ret_eef_pose=True)
        return pose, jacobian

    def forward(self, kinematic_state: Tensor, action: Tensor) -> Tensor:
        """One control step.

        Args:
            kinematic_state: [*B, 20].
            action: [*B, 7], clipped to [-1, 1]; +1 is 0.05 m, 0.5 rad (world axes), or closing the gripper.

        Returns:
            The next kinematic state [*B, 20].

        Raises:
            ValueError: a last dimension other than 20 and 7, or batches that differ.
        """
        _check(kinematic_state, action, action.shape[:-1])
        batch = kinematic_state.shape[:-1]
        return self._advance(kinematic_state.reshape(-1, KINEMATIC_DIM), action.reshape(-1, ACTION_DIM)).reshape(
            *batch, KINEMATIC_DIM
        )

    def rollout(self, kinematic_state: Tensor, actions: Tensor) -> Tensor:
        """The states [*B, C, 20] after each of the actions [*B, C, 7], starting from [*B, 20]."""
        _check(kinematic_state, actions, actions.shape[:-2])
        batch, length = kinematic_state.shape[:-1], actions.shape[-2]
        state = kinematic_state.reshape(-1, KINEMATIC_DIM)
        states = []
        for action in actions.reshape(-1, length, ACTION_DIM).unbind(1):
            state = self._advance(state, action)
            states.append(state)
        return torch.stack(states, 1).reshape(*batch, length, KINEMATIC_DIM)

    def _advance(self, state: Tensor, action: Tensor) -> Tensor:
        q, target, opening = state[:, :7], state[:, 7:10], state[:, 19:]
        target_rotation = state[:, 10:19].reshape(-1, 3, 3)
        action = action.to(state.dtype).clamp(-1, 1)
        target = (target + POSITION_STEP * action[:, :3]).clamp(self._workspace_low, self._workspace_high)
        target_rotation = _exp(ROTATION_STEP * action[:, 3:6]) @ target_rotation
        opening = (opening - panda.GRIPPER_RATE * action[:, 6:].sign()).clamp(0, 1)

        pose, jacobian = self._tcp(q)
        error = torch.cat(
            [target - pose[:, :3, 3], _log(target_rotation @ pose[:, :3, :3].transpose(-1, -2))], -1
        )  # [n, 6]
        transposed = jacobian.transpose(-1, -2)
        step = (transposed @ torch.linalg.solve(jacobian @ transposed + self._damping, error.unsqueeze(-1))).squeeze(-1)
        step = step * (panda.MAX_JOINT_STEP / step.abs().amax(-1, keepdim=True).clamp(min=1e-12)).clamp(max=1.0)
        q = (q + step).clamp(self._joint_low, self._joint_high)
        return torch.cat([q, target, target_rotation.flatten(1), opening], -1)

    def pose(self, kinematic_state: Tensor) -> Tensor:
        """Pose of the tool centre [*B, 13]: position (m), rotation (row-major), commanded opening; from the joints."""
        flat = kinematic_state.reshape(-1, KINEMATIC_DIM)
        tcp = self._chain.forward_kinematics_tensor(flat[:, :7])[self._chain._serial_eef_frame_idx]
        pose = torch.cat([tcp[:, :3, 3], tcp[:, :3, :3].flatten(1), flat[:, 19:]], -1)
        return pose.reshape(*kinematic_state.shape[:-1], 13)

    @staticmethod
    def commanded_pose(kinematic_state: Tensor) -> Tensor:
        """The accumulated target [*B, 13]: x_des, R_des, commanded opening."""
        return kinematic_state[..., 7:20]

    def state(self, kinematic_state: Tensor, proprio: str = "commanded") -> Tensor:
        """Proprioception [*B, 7]: position (m), axis-angle (rad), opening.

        ``proprio="commanded"`` takes the accumulated target, which is the same number in physics and imagination,
        ``"measured"`` the pose of the joints.
        """
        if proprio not in ("measured", "commanded"):
            raise ValueError(f'proprio must be "measured" or "commanded", got {proprio!r}')
        pose = self.pose(kinematic_state) if proprio == "measured" else self.commanded_pose(kinematic_state)
        rotation = pose[..., 3:12].reshape(*pose.shape[:-1], 3, 3)
        return torch.cat([pose[..., :3], _axis_angle(rotation), pose[..., 12:]], -1)

    def path_actions(self, kinematic_states: Tensor) -> Tensor:
        """The poses' part [*B, T, 6] of the actions that take the target from each of the states [*B, T + 1, 20] to the
        next one; beyond [-1, 1] where that is further than an action goes."""
        before, after = kinematic_states[..., :-1, 7:19], kinematic_states[..., 1:, 7:19]
        turned = after[..., 3:].unflatten(-1, (3, 3)) @ before[..., 3:].unflatten(-1, (3, 3)).mT
        turn = _log(turned.reshape(-1, 3, 3)).reshape(*before.shape[:-1], 3)
        return torch.cat([(after[..., :3] - before[..., :3]) / POSITION_STEP, turn / ROTATION_STEP], -1)

    def initial_state(self, q: Tensor, opening: float = 1.0) -> Tensor:
        """The kinematic state [*B, 20] at rest at joints [*B, 7]: the target is where the hand is."""
        state = torch.cat([q, q.new_zeros(*q.shape[:-1], 12), q.new_full((*q.shape[:-1], 1), opening)], -1)
        return torch.cat([q, self.pose(state)], -1)


def _check(kinematic_state: Tensor, action: Tensor, action_batch: torch.Size) -> None:
    if kinematic_state.shape[-1] != KINEMATIC_DIM:
        raise ValueError(f"kinematic_state must be [*B, {KINEMATIC_DIM}], got {tuple(kinematic_state.shape)}")
    if action.shape[-1] != ACTION_DIM or action_batch != kinematic_state.shape[:-1]:
        raise ValueError(
            f"actions must be [*B(, C), {ACTION_DIM}] with the states' batch {tuple(kinematic_state.shape[:-1])}, "
            f"got {tuple(action.shape)}"
        )


def _exp(vector: Tensor) -> Tensor:
    """Rotation matrices [n, 3, 3] of rotation vectors [n, 3] (Rodrigues)."""
    square = vector.square().sum(-1)[:, None, None]
    small = square < 1e-8
    angle = square.clamp(min=1e-8).sqrt()
    first = torch.where(small, 1 - square / 6, angle.sin() / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / angle.square())
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + first * skew + second * (skew @ skew)


def _log(rotation: Tensor) -> Tensor:
    """Rotation vectors [n, 3] of rotation matrices [n, 3, 3]; for the controller's errors, far below pi."""
    skew = 0.5 * torch.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        -1,
    )  # sin(angle) * axis
    square = skew.square().sum(-1, keepdim=True)
    small = square < 1e-8
    sine = square.clamp(min=1e-8).sqrt()
    cosine = 0.5 * (rotation.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    return skew * torch.where(small, 1 + square / 6, torch.atan2(sine, cosine) / sine)


def _axis_angle(rotation: Tensor) -> Tensor:
    """Axis-angle [*B, 3] of rotation matrices [*B, 3, 3], continuous around the tool pointing down.

    The hand works near a half turn about x, where the usual choice (angle at most pi) flips its sign for nothing; the
    quaternion with a positive x component is taken instead, and the angle runs to 2 pi.
    """
    m = rotation.flatten(-2)
    xx, yy, zz = m[..., 0], m[..., 4], m[..., 8]
    # The same quaternion (w, x, y, z) four times, scaled by 4w, 4x, 4y and 4z: the largest is well conditioned.
    forms = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, m[..., 7] - m[..., 5], m[..., 2] - m[..., 6], m[..., 3] - m[..., 1]], -1),
            torch.stack([m[..., 7] - m[..., 5], 1 + xx - yy - zz, m[..., 3] + m[..., 1], m[..., 2] + m[..., 6]], -1),
            torch.stack([m[..., 2] - m[..., 6], m[..., 3] + m[..., 1], 1 - xx + yy - zz, m[..., 7] + m[..., 5]], -1),
            torch.stack([m[..., 3] - m[..., 1], m[..., 2] + m[..., 6], m[..., 7] + m[..., 5], 1 - xx - yy + zz], -1),
        ],
        -2,
    )  # [*B, 4, 4]
    largest = forms.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*forms.shape[:-2], 1, 4)
    quaternion = nn.functional.normalize(forms.gather(-2, largest).squeeze(-2), dim=-1)
    quaternion = torch.where(quaternion[..., 1:2] < 0, -quaternion, quaternion)
    square = quaternion[..., 1:].square().sum(-1, keepdim=True)
    sine = square.clamp(min=1e-12).sqrt()
    angle = 2 * torch.atan2(sine, quaternion[..., :1])
    return torch.where(square < 1e-12, 2 * quaternion[..., 1:], quaternion[..., 1:] * angle / sine)
