"""The control rule against MuJoCo's own kinematics and hand-made rotations."""

import math

import mujoco
import numpy as np

from worldenv_trl.robot import panda
from worldenv_trl.scenes import controller, load_task

RNG = np.random.default_rng(0)


def random_q(n):
    return RNG.uniform(panda.JOINT_LOW, panda.JOINT_HIGH, (n, 7))


def test_forward_kinematics_and_jacobian_equal_mujoco_s():
    model = load_task("starter/open_the_top_drawer").build()
    data = mujoco.MjData(model)
    site = model.site("panda/tcp").id
    columns = [model.jnt_dofadr[model.joint(f"panda/{joint.name}").id] for joint in panda.JOINTS]
    angles = [model.jnt_qposadr[model.joint(f"panda/{joint.name}").id] for joint in panda.JOINTS]
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    q = random_q(20)
    position, rotation, jacobian = controller.forward_kinematics(q)
    for row in range(len(q)):
        data.qpos[angles] = q[row]
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, linear, angular, site)
        assert np.allclose(position[row], data.site_xpos[site], atol=1e-9)
        assert np.allclose(rotation[row].ravel(), data.site_xmat[site], atol=1e-9)
        assert np.allclose(jacobian[row], np.concatenate([linear, angular])[:, columns], atol=1e-9)


def test_rotation_vectors_go_there_and_back():
    vectors = RNG.normal(size=(50, 3))
    vectors *= (RNG.uniform(0, math.pi - 1e-3, 50) / np.linalg.norm(vectors, axis=1))[:, None]
    vectors = np.concatenate([vectors, np.zeros((1, 3)), [[1e-10, 0, 0]]])
    back = controller.vector_from_rotation(controller.rotation_from_vector(vectors))
    assert np.allclose(back, vectors, atol=1e-7)


def test_a_half_turn_has_a_vector_of_length_pi():
    for axis in np.concatenate([np.eye(3), [[0.6, -0.8, 0]]]):
        half = 2 * np.outer(axis, axis) - np.eye(3)
        vector = controller.vector_from_rotation(half[None])
        assert np.allclose(controller.rotation_from_vector(vector)[0], half, atol=1e-9)
        assert np.isclose(np.linalg.norm(vector), math.pi)


def test_the_hand_s_axis_angle_does_not_jump_around_straight_down():
    down = np.diag([1.0, -1.0, -1.0])
    tilts = np.stack([np.linspace(-0.3, 0.3, 61), np.linspace(0.2, -0.2, 61), np.linspace(-0.2, 0.2, 61)], 1)
    rotation = controller.rotation_from_vector(tilts) @ down
    vectors = controller.hand_axis_angle(rotation)
    assert np.abs(np.diff(vectors, axis=0)).max() < 0.02
    assert np.allclose(controller.rotation_from_vector(vectors), rotation, atol=1e-9)


def test_one_action_moves_the_target_by_its_steps_in_world_axes():
    targets = controller.reset_targets(panda.HOME_Q[None], np.array([1.0]))
    action = np.array([[1.0, -0.5, 0.2, 0.0, 0.0, 1.0, 1.0]])
    moved = controller.advance_targets(targets, action)
    assert np.allclose(moved[0, :3] - targets[0, :3], [0.05, -0.025, 0.01])
    c, s = math.cos(0.5), math.sin(0.5)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ targets[0, 3:12].reshape(3, 3)
    assert np.allclose(moved[0, 3:12].reshape(3, 3), turned)
    assert np.isclose(moved[0, 12], 0.8)


def test_actions_are_clipped_and_targets_stay_in_the_workspace():
    targets = controller.reset_targets(panda.HOME_Q[None], np.array([1.0]))
    assert np.allclose(
        controller.advance_targets(targets, np.full((1, 7), 7.0)), controller.advance_targets(targets, np.ones((1, 7)))
    )
    for _ in range(40):
        targets = controller.advance_targets(targets, np.array([[1, 1, -1, 0, 0, 0, 0.0]]))
    expected = [panda.WORKSPACE_HIGH[0], panda.WORKSPACE_HIGH[1], panda.WORKSPACE_LOW[2]]
    assert np.allclose(targets[0, :3], expected)


def test_a_zero_gripper_action_holds():
    targets = controller.reset_targets(panda.HOME_Q[None], np.array([0.6]))
    assert controller.advance_targets(targets, np.zeros((1, 7)))[0, 12] == 0.6


def test_joint_targets_reach_the_pose_inside_the_limits():
    targets = controller.reset_targets(panda.HOME_Q[None], np.array([1.0]))
    targets = controller.advance_targets(targets, np.array([[0.8, 0.5, -0.6, 0.3, -0.2, 0.4, 0]]))
    q = panda.HOME_Q[None]
    for _ in range(6):
        q = controller.joint_targets(q, targets)
    position, rotation, _ = controller.forward_kinematics(q)
    assert np.allclose(position, targets[:, :3], atol=1e-4)
    assert np.allclose(rotation.reshape(1, 9), targets[:, 3:12], atol=1e-3)
    far = targets.copy()
    far[:, :3] = [3.0, 0, 3.0]
    for _ in range(20):
        q = controller.joint_targets(q, far)
        assert (q >= panda.JOINT_LOW).all() and (q <= panda.JOINT_HIGH).all()


def test_a_row_does_not_depend_on_how_many_rows_there_are():
    q, n = random_q(16), 16
    targets = controller.reset_targets(random_q(n), RNG.uniform(0, 1, n))
    action = RNG.uniform(-1, 1, (n, 7))
    together = controller.joint_targets(q, controller.advance_targets(targets, action))
    for row in range(n):
        one = slice(row, row + 1)
        alone = controller.joint_targets(q[one], controller.advance_targets(targets[one], action[one]))
        assert np.array_equal(together[row], alone[0])
