"""What the objects do when they are gripped, pulled, pushed and left alone."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from worldenv_trl.scenes import SceneBatch, load_task
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Bowl, Plate

BOWL, DRAWER, STOVE = "starter/put_the_bowl_on_the_plate", "starter/open_the_top_drawer", "starter/turn_on_the_stove"
GRIP = Bowl.HEIGHT - 0.022
ABOVE = np.array([0.0, 0.0, 0.12])


def _scene(name: str, rows: int) -> SceneBatch:
    task = load_task(name)
    scene = SceneBatch(task, rows, cameras=(), num_threads=1)
    scene.reset(np.arange(rows), task.init_states("train", rows))
    return scene


def _drive(scene: SceneBatch, goal: np.ndarray, gripper: float, steps: int, speed: float = 0.4) -> None:
    """Moves the commanded position in straight lines to ``goal [n, 3]``."""
    for _ in range(steps):
        action = np.zeros((scene.num_envs, 7))
        action[:, :3] = np.clip((goal - scene.commanded_state()[:, :3]) / 0.05, -speed, speed)
        action[:, 6] = gripper
        scene.step(action)


def _lift(offset: tuple[float, float, float], rows: int = 8) -> np.ndarray:
    """Height gained by the bowl ``[rows]`` when the hand closes ``offset`` away from the middle of the rim."""
    scene = _scene(BOWL, rows)
    bowl = scene.model.body("bowl_1/").id
    rim = scene.xpos[:, bowl] + (0.0, Bowl.RIM_RADIUS - 0.004, GRIP) + offset
    start = scene.xpos[:, bowl, 2].copy()
    _drive(scene, rim + ABOVE, -1.0, 12)
    _drive(scene, rim, -1.0, 9)
    _drive(scene, rim, 1.0, 8)
    _drive(scene, rim + ABOVE, 1.0, 10)
    _drive(scene, rim + ABOVE, 0.0, 20)
    return scene.xpos[:, bowl, 2] - start


@pytest.mark.parametrize("offset", [(0, 0, 0), (0.01, 0, 0), (-0.01, 0, 0), (0, 0.01, 0), (0, -0.01, 0), (0, 0, 0.005)])
def test_a_grip_within_a_centimetre_of_the_rim_lifts_the_bowl_and_keeps_it(offset):
    assert _lift(offset).min() > 0.08


@pytest.mark.parametrize("offset", [(0, -0.045, 0), (0, 0, 0.035), (0.07, 0, 0)])
def test_a_grip_that_misses_the_rim_leaves_the_bowl_on_the_table(offset):
    assert _lift(offset).max() < 0.02


def test_a_gripped_bowl_hangs_level():
    scene = _scene(BOWL, 6)
    bowl = scene.model.body("bowl_1/").id
    rim = scene.xpos[:, bowl] + (0.0, Bowl.RIM_RADIUS - 0.004, GRIP)
    for goal, gripper, steps in ((rim + ABOVE, -1, 12), (rim, -1, 9), (rim, 1, 8), (rim + ABOVE, 1, 12)):
        _drive(scene, goal, gripper, steps)
    upright = scene.xmat[:, bowl].reshape(-1, 9)[:, 8]
    assert upright.min() > np.cos(np.radians(12))


def test_a_drawer_slides_when_pulled_stays_where_it_is_left_and_stops_at_its_end():
    model = load_task(DRAWER).build()
    data = mujoco.MjData(model)
    joint = model.joint("cabinet_1/top")
    position, velocity = joint.qposadr[0], joint.dofadr[0]
    data.qfrc_applied[velocity] = -8.0
    mujoco.mj_step(model, data, 100)
    assert data.qpos[position] < Cabinet.OPEN_BELOW
    mujoco.mj_step(model, data, 400)
    assert data.qpos[position] > -0.17
    data.qfrc_applied[velocity] = 0.0
    mujoco.mj_step(model, data, 50)
    left = data.qpos[position]
    mujoco.mj_step(model, data, 400)
    assert abs(data.qpos[position] - left) < 1e-3
    for other in ("middle", "bottom"):
        assert abs(data.qpos[model.joint(f"cabinet_1/{other}").qposadr[0]]) < 1e-3


@pytest.mark.parametrize("angle", [0.3, Stove.ON_ABOVE + 0.1])
def test_the_lever_of_the_stove_stays_where_it_is_left(angle):
    scene = _scene(STOVE, 1)
    lever = scene.model.jnt_qposadr[scene.model.joint("stove_1/lever").id]
    scene.qpos[:, lever] = angle
    for _ in range(20):
        scene.step(np.zeros((1, 7)))
    assert abs(scene.qpos[0, lever] - angle) < 1e-3


def test_the_lever_turns_only_when_its_peg_is_pushed():
    scene = _scene(STOVE, 2)
    lever = scene.model.jnt_qposadr[scene.model.joint("stove_1/lever").id]
    peg = scene.site_xpos[:, scene.model.site("stove_1/peg").id].copy()
    aside = np.array([[-0.06, 0.0, 0.0], [-0.06, 0.0, 0.12]])  # row 1 passes above it
    _drive(scene, peg + aside + ABOVE, 1.0, 14)
    _drive(scene, peg + aside, 1.0, 8)
    _drive(scene, peg + (0.03, 0, 0) + aside * (0, 0, 1), 1.0, 10)
    assert scene.qpos[0, lever] > 0.2
    assert scene.qpos[1, lever] == pytest.approx(0.0, abs=1e-3)


def test_fixtures_do_not_move_when_the_hand_pushes_them():
    scene = _scene(DRAWER, 2)
    cabinet = scene.model.body("cabinet_1/").id
    before = scene.xpos[:, cabinet].copy()
    _drive(scene, before + (0.5 * ABOVE), 1.0, 30)
    assert np.array_equal(scene.xpos[:, cabinet], before)


def test_objects_have_the_sizes_that_scripts_and_predicates_rely_on():
    model = load_task(BOWL).build()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bowl, plate = model.body("bowl_1/").id, model.body("plate_1/").id

    def extent(body: int, axis: int) -> tuple[float, float]:
        """Lowest and highest vertex of the body's boxes and cylinders along an axis, from its origin."""
        ends = []
        for geom in np.flatnonzero(model.geom_bodyid == body):
            rotation, size = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER:
                reach = size[0] * np.hypot(*rotation[axis, :2]) + size[1] * abs(rotation[axis, 2])
            else:
                reach = np.abs(rotation[axis]) @ size
            ends += [data.geom_xpos[geom, axis] - reach, data.geom_xpos[geom, axis] + reach]
        return min(ends) - data.xpos[body, axis], max(ends) - data.xpos[body, axis]

    low, high = extent(bowl, 2)
    assert high == pytest.approx(Bowl.HEIGHT, abs=0.002)
    assert low == pytest.approx(0.0, abs=0.002)
    assert extent(bowl, 0)[1] == pytest.approx(Bowl.RIM_RADIUS, abs=0.006)
    assert extent(plate, 2)[1] == pytest.approx(Plate.TOP, abs=0.001)
    assert model.body_subtreemass[bowl] == pytest.approx(0.1, abs=0.01)
