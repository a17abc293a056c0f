"""The camera model against MuJoCo's renderer."""

import mujoco
import numpy as np
import pytest

from worldenv_trl.scenes import load_task
from worldenv_trl.scenes.camera import Camera, look_at

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
