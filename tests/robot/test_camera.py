"""The camera model against MuJoCo's renderer and its wrist camera."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest

from worldenv_trl.robot import WRIST, Camera, look_at, panda
from worldenv_trl.scenes import load_task

SIZE = 96
CAMERA = look_at("view", (0.7, 0.2, 0.6), (0.0, 0.05, 0.1), 40.0)
POINTS = np.array([[0, 0, 0], [0.1, 0.15, 0.2], [-0.15, -0.1, 0.05], [0.2, -0.1, 0.0]])


@pytest.mark.parametrize("point", POINTS, ids=str)
def test_a_point_is_projected_to_where_mujoco_draws_it(point):
    axes = " ".join(map(str, CAMERA.axes))
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><visual><map znear="0.01"/></visual><worldbody>
        <camera name="view" pos="{" ".join(map(str, CAMERA.position))}" xyaxes="{axes}" fovy="{CAMERA.fovy}"/>
        <geom type="sphere" size="0.012" pos="{" ".join(map(str, point))}" rgba="1 1 1 1"/></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, SIZE, SIZE) as renderer:
        renderer.update_scene(data, "view")
        bright = renderer.render().sum(-1) > 60
    rows, columns = np.nonzero(bright)
    assert np.allclose(CAMERA.project(point, SIZE), [columns.mean() + 0.5, rows.mean() + 0.5], atol=0.5)


def test_projection_is_that_of_the_intrinsics():
    local = (POINTS - np.array(CAMERA.position)) @ np.array(CAMERA.rotation)
    flipped = local * [1, -1, -1]  # computer vision: y down, z forward
    homogeneous = flipped @ CAMERA.intrinsics(SIZE).T
    assert np.allclose(CAMERA.project(POINTS, SIZE), homogeneous[:, :2] / homogeneous[:, 2:])


def test_what_a_camera_looks_at_is_in_the_middle():
    assert np.allclose(CAMERA.project(np.array([0.0, 0.05, 0.1]), SIZE), SIZE / 2)


def test_the_task_s_camera_is_the_model_s():
    task = load_task("starter/put_the_bowl_on_the_plate")
    camera, model = task.camera("agentview"), task.build()
    assert isinstance(camera, Camera)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    index = model.camera("agentview").id
    assert np.allclose(data.cam_xpos[index], camera.position)
    assert np.allclose(data.cam_xmat[index].reshape(3, 3), camera.rotation, atol=1e-6)
    assert model.cam_fovy[index] == camera.fovy


def test_the_wrist_camera_rides_on_the_tool_as_mujoco_has_it():
    task = load_task("starter/put_the_bowl_on_the_plate")
    assert task.camera("wrist") == WRIST
    model, place, turn = task.build(), np.array(WRIST.position), np.array(WRIST.rotation)
    data, camera, tool = mujoco.MjData(model), model.camera("panda/wrist").id, model.site("panda/tcp").id
    arm = [model.joint(f"panda/{joint.name}").qposadr[0] for joint in panda.JOINTS]
    for angles in np.random.default_rng(0).uniform(panda.JOINT_LOW, panda.JOINT_HIGH, (50, 7)):
        data.qpos[arm] = angles
        mujoco.mj_forward(model, data)
        rotation = data.site_xmat[tool].reshape(3, 3)
        assert np.allclose(data.cam_xpos[camera], data.site_xpos[tool] + rotation @ place, atol=1e-12)
        assert np.allclose(data.cam_xmat[camera].reshape(3, 3), rotation @ turn, atol=1e-12)
    assert model.cam_fovy[camera] == WRIST.fovy


def test_a_camera_is_mounted_on_the_world_or_the_tool():
    with pytest.raises(ValueError, match="mount must be 'world' or 'tool', got 'hand'"):
        Camera("side", (0.0, 0.0, 0.0), WRIST.rotation, 40.0, mount="hand")


def test_a_camera_read_from_json_is_the_one_that_was_written():
    again = Camera(**json.loads(json.dumps(dataclasses.asdict(WRIST))))
    assert again == WRIST and hash(again) == hash(WRIST)
