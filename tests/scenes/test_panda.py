"""The arm in MuJoCo: the published numbers, and servos that hold it."""

import mujoco
import numpy as np
import pytest

from worldenv_trl.robot import panda
from worldenv_trl.scenes import SceneBatch, controller, load_task

MODEL = load_task("starter/open_the_top_drawer").build()


def test_the_tcp_of_a_known_pose_is_where_the_datasheet_puts_it():
    # With all joints at zero: 0.333 + 0.316 + 0.384 m up, minus flange and hand, 0.088 m forward.
    position, rotation, _ = controller.forward_kinematics(np.zeros((1, 7)))
    up = 0.333 + 0.316 + 0.384 - 0.107 - 0.1034
    assert np.allclose(position[0] - panda.BASE_POSITION, [0.088, 0, up], atol=1e-12)
    assert np.allclose(rotation[0, :, 2], [0, 0, -1], atol=1e-12)


def test_the_model_carries_the_published_limits_masses_and_inertias():
    for joint in panda.JOINTS:
        mine = MODEL.joint(f"panda/{joint.name}")
        assert np.allclose(mine.range, (joint.lower, joint.upper))
        body = MODEL.body(f"panda/{joint.name.replace('joint', 'link')}")
        assert body.mass[0] == pytest.approx(joint.mass)
        xx, yy, zz, xy, xz, yz = joint.inertia
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert np.allclose(np.sort(body.inertia), principal, atol=1e-6)


def test_home_is_inside_the_limits_with_the_hand_straight_down():
    assert (panda.HOME_Q > panda.JOINT_LOW + 0.1).all() and (panda.HOME_Q < panda.JOINT_HIGH - 0.1).all()
    position, rotation, _ = controller.forward_kinematics(panda.HOME_Q[None])
    assert (position[0] > panda.WORKSPACE_LOW).all() and (position[0] < panda.WORKSPACE_HIGH).all()
    assert np.degrees(np.arccos(-rotation[0, 2, 2])) < 0.1


def test_the_servos_hold_the_arm_still_for_two_seconds():
    task = load_task("starter/open_the_top_drawer")
    scene = SceneBatch(task, 1, cameras=())
    scene.reset([0], task.init_states("train", 1))
    before = scene.measured_state()
    for _ in range(40):
        scene.step(np.zeros((1, 7)))
    after = scene.measured_state()
    assert np.abs(after - before)[0, :3].max() < 1e-3 and np.abs(after - before)[0, 3:].max() < 5e-3


def test_the_gripper_closes_and_opens_at_its_rate():
    task = load_task("starter/open_the_top_drawer")
    scene = SceneBatch(task, 1, cameras=())
    scene.reset([0], task.init_states("train", 1))
    close = np.zeros((1, 7))
    close[:, 6] = 1.0
    commanded = []
    for _ in range(7):
        scene.step(close)
        commanded.append(scene.commanded_state()[0, 6])
    assert np.allclose(commanded, [0.8, 0.6, 0.4, 0.2, 0, 0, 0], atol=1e-6)
    assert scene.measured_state()[0, 6] < 0.05
    for _ in range(8):
        scene.step(-0.3 * close)  # only the sign counts
    assert scene.measured_state()[0, 6] > 0.95


def test_only_the_hand_touches_things():
    names = {MODEL.geom(i).name for i in range(MODEL.ngeom) if MODEL.geom_contype[i] or MODEL.geom_conaffinity[i]}
    assert {name for name in names if name.startswith("panda/")} == {"panda/palm", "panda/left_pad", "panda/right_pad"}
    assert mujoco.mj_name2id(MODEL, mujoco.mjtObj.mjOBJ_CAMERA, "panda/wrist") >= 0
