"""Forward kinematics against MuJoCo, the simulated controller's NumPy rule and finite differences."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.robot import panda
from worldenv_trl.scenes import controller
from worldenv_trl.scenes.panda import Panda

FK = ForwardKinematics()
HOME = torch.as_tensor(panda.HOME_Q, dtype=torch.float32)


def random_joints(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(panda.JOINT_LOW, panda.JOINT_HIGH, (count, 7))


def near_home(count: int, seed: int = 0) -> torch.Tensor:
    return HOME + 0.1 * torch.randn(count, 7, generator=torch.Generator().manual_seed(seed))


def random_actions(*shape: int, seed: int = 0) -> torch.Tensor:
    return 2 * torch.rand(*shape, 7, generator=torch.Generator().manual_seed(seed)) - 1


def rotation(pose: torch.Tensor) -> torch.Tensor:
    return pose[..., 3:12].unflatten(-1, (3, 3))


def test_the_tool_centre_is_where_mujoco_puts_it():
    model = Panda().mjcf_model
    physics = mujoco.MjModel.from_xml_string(model.to_xml_string())
    data, site = mujoco.MjData(physics), mujoco.mj_name2id(physics, mujoco.mjtObj.mjOBJ_SITE, "tcp")
    q = random_joints(100)
    pose = FK.pose(FK.initial_state(torch.as_tensor(q, dtype=torch.float32)))
    for row, angles in enumerate(q):
        data.qpos[:7] = angles
        mujoco.mj_kinematics(physics, data)
        expected = data.site_xpos[site] + panda.BASE_POSITION
        assert np.abs(pose[row, :3].numpy() - expected).max() < 1e-5
        assert np.abs(pose[row, 3:12].numpy() - data.site_xmat[site]).max() < 1e-5


def test_a_rollout_is_the_simulated_controllers_rule():
    fk = ForwardKinematics().double()  # single precision differs by a tenth of a millimetre near singular poses
    q = near_home(16).double().numpy()
    targets = controller.reset_targets(q, np.ones(16))
    actions = random_actions(16, 40).double() * torch.tensor([0.6] * 3 + [0.1] * 3 + [1.0])
    states = fk.rollout(fk.initial_state(torch.as_tensor(q)), actions)
    for step in range(40):
        targets = controller.advance_targets(targets, actions[:, step].numpy())
        q = controller.joint_targets(q, targets)
        assert np.abs(states[:, step, 7:].numpy() - targets).max() < 1e-6
        assert np.abs(states[:, step, :7].numpy() - q).max() < 1e-5
        assert np.abs(fk.pose(states[:, step])[:, :3].numpy() - controller.forward_kinematics(q)[0]).max() < 1e-5


def test_targets_follow_the_controller_through_actions_beyond_their_bounds():
    state, actions = FK.initial_state(near_home(16)), 3 * random_actions(16, 20)
    targets = FK.commanded_pose(state).double().numpy()
    states = FK.rollout(state, actions)
    for step in range(20):
        targets = controller.advance_targets(targets, actions[:, step].double().numpy())
        assert np.abs(FK.commanded_pose(states[:, step]).numpy() - targets).max() < 1e-5


def test_rollout_repeats_forward_on_any_batch():
    state, actions = FK.initial_state(near_home(6)).view(2, 3, 20), random_actions(2, 3, 5)
    states = FK.rollout(state, actions)
    for step in range(5):
        state = FK(state, actions[:, :, step])
        assert torch.allclose(states[:, :, step], state, atol=1e-6)


def test_a_row_does_not_depend_on_its_batch():
    state, actions = FK.initial_state(near_home(16)), random_actions(16, 8)
    together = FK.rollout(state, actions)
    for row in range(16):
        assert torch.allclose(FK.rollout(state[row], actions[row]), together[row], atol=1e-5)


def test_one_metre_and_one_radian_mean_what_the_actions_say():
    state = FK.initial_state(HOME)
    action = torch.tensor([0.2, -0.4, 0.6, 0.0, 0.0, 0.4, 0.0])
    before, after = FK.commanded_pose(state), FK.commanded_pose(FK(state, action))
    assert torch.allclose(after[:3] - before[:3], 0.05 * action[:3], atol=1e-6)
    turn = rotation(after) @ rotation(before).T
    c, s = math.cos(0.2), math.sin(0.2)
    assert torch.allclose(turn, torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]), atol=1e-6)
    settled = FK.rollout(state, torch.cat([action[None], torch.zeros(15, 7)]))[-1]
    assert torch.allclose(FK.pose(settled)[:12], FK.commanded_pose(settled)[:12], atol=1e-4)


def test_the_gripper_closes_on_plus_one_opens_on_minus_one_and_holds_on_zero():
    state = FK.initial_state(HOME, opening=0.5)
    command = torch.zeros(4, 7)
    command[:, 6] = torch.tensor([0.3, -0.3, 0.0, 1.0])
    opening = FK(state.expand(4, 20), command)[:, 19]
    rate = panda.GRIPPER_RATE
    assert torch.allclose(opening, torch.tensor([0.5 - rate, 0.5 + rate, 0.5, 0.5 - rate]))
    closed = FK.rollout(state, command[3].expand(10, 7))[-1, 19]
    assert closed == 0


def test_joints_and_targets_stay_inside_their_limits():
    state = FK.initial_state(near_home(32))
    for sign in (-1.0, 1.0):
        actions = torch.full((32, 60, 7), sign)
        states = FK.rollout(state, actions)
        q, target = states[..., :7], states[..., 7:10]
        low, high = (torch.as_tensor(x, dtype=torch.float32) for x in (panda.JOINT_LOW, panda.JOINT_HIGH))
        assert (q >= low).all() and (q <= high).all()
        low, high = (torch.as_tensor(x, dtype=torch.float32) for x in (panda.WORKSPACE_LOW, panda.WORKSPACE_HIGH))
        assert (target >= low).all() and (target <= high).all()
        assert torch.equal(target[:, -1], (low if sign < 0 else high).expand(32, 3))


def test_targets_stay_rotations_over_a_long_episode():
    states = FK.rollout(FK.initial_state(near_home(4)), random_actions(4, 300))
    target = rotation(FK.commanded_pose(states[:, -1]))
    assert torch.allclose(target @ target.mT, torch.eye(3).expand(4, 3, 3), atol=1e-4)


def test_the_state_names_position_rotation_and_opening():
    state = FK.rollout(FK.initial_state(near_home(8)), random_actions(8, 4))[:, -1]
    for proprio, pose in (("measured", FK.pose(state)), ("commanded", FK.commanded_pose(state))):
        named = FK.state(state, proprio)
        assert torch.equal(named[:, :3], pose[:, :3]) and torch.equal(named[:, 6], pose[:, 12])
        turns = controller.rotation_from_vector(named[:, 3:6].double().numpy())
        assert np.abs(turns - rotation(pose).numpy()).max() < 1e-5


def test_the_axis_angle_does_not_jump_where_the_hand_works():
    # A sway of a tenth of a degree about every axis around the tool pointing straight down.
    base = FK.initial_state(HOME)
    base[10:19] = torch.diag(torch.tensor([1.0, -1.0, -1.0])).flatten()
    sway = 0.004 * random_actions(64)
    sway[:, 6] = 0
    named = FK.state(FK(base.expand(64, 20), sway), "commanded")
    assert (named[:, 3:6] - FK.state(base, "commanded")[3:6]).abs().max() < 0.01


def test_gradients_equal_finite_differences():
    fk = ForwardKinematics().double()
    state = fk.initial_state(near_home(2).double()).requires_grad_()
    pose_actions = 0.5 * random_actions(2, 2)[..., :6].double()
    pose_actions = pose_actions.requires_grad_()

    def reached(state, pose_actions):
        actions = torch.cat([pose_actions, pose_actions.new_ones(2, 2, 1)], -1)
        return fk.pose(fk.rollout(state, actions))

    assert torch.autograd.gradcheck(reached, (state, pose_actions))


def test_gradients_at_zero_actions_are_finite():
    actions = torch.zeros(3, 4, 7, requires_grad=True)
    FK.pose(FK.rollout(FK.initial_state(near_home(3)), actions))[..., :3].sum().backward()
    assert actions.grad.isfinite().all() and (actions.grad[..., :3] != 0).all()


def test_wrong_shapes_and_proprio_are_refused():
    state = FK.initial_state(near_home(2))
    with pytest.raises(ValueError, match="kinematic_state must be"):
        FK(state[:, :7], torch.zeros(2, 7))
    with pytest.raises(ValueError, match="actions must be"):
        FK(state, torch.zeros(2, 6))
    with pytest.raises(ValueError, match="actions must be"):
        FK.rollout(state, torch.zeros(3, 8, 7))
    with pytest.raises(ValueError, match="proprio"):
        FK.state(state, "exact")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_the_gpu_agrees_with_the_cpu():
    state, actions = FK.initial_state(near_home(4)), random_actions(4, 8)
    on_gpu = ForwardKinematics().cuda()
    assert torch.allclose(on_gpu.rollout(state.cuda(), actions.cuda()).cpu(), FK.rollout(state, actions), atol=1e-4)
