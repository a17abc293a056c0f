"""Batched simulation: exact resets, rows that ignore each other, fields and images of the current state."""

import copy

import mujoco
import numpy as np
import pytest

from worldenv_trl.scenes import SceneBatch, ScriptedExpert, list_tasks, load_task

TASKS = list_tasks("starter")
RNG = np.random.default_rng(0)


def make(name=TASKS[0], n=4, **options):
    task = load_task(name)
    options = {"cameras": (), "num_threads": 1} | options
    scene = SceneBatch(task, n, **options)
    scene.reset(np.arange(n), task.init_states("train", max(n, 4))[:n])
    return scene


def grasp(scene, steps=24):
    """Plays the expert into contact with things, where simulations are least forgiving."""
    expert = ScriptedExpert(scene.task)
    for _ in range(steps):
        scene.step(expert(scene))


@pytest.mark.parametrize("name", TASKS)
def test_a_reset_in_the_middle_of_a_grasp_continues_bit_for_bit(name):
    scene = make(name)
    grasp(scene)
    state = scene.sim_state()
    actions = RNG.uniform(-0.6, 0.6, (6, 4, 7))
    for action in actions:
        scene.step(action)
    first, kinematic, success = scene.sim_state(), scene.kinematic_state(), scene.success()
    grasp(scene, 3)
    scene.reset(np.arange(4), state)
    assert np.array_equal(scene.sim_state(), state)
    for action in actions:
        scene.step(action)
    assert np.array_equal(scene.sim_state(), first)
    assert np.array_equal(scene.kinematic_state(), kinematic) and np.array_equal(scene.success(), success)


@pytest.mark.parametrize("name", TASKS)
def test_a_row_alone_moves_as_in_a_batch_on_two_threads(name):
    many = make(name, 5, num_threads=2)
    grasp(many)
    state, actions = many.sim_state(), RNG.uniform(-0.5, 0.5, (8, 5, 7))
    for action in actions:
        many.step(action)
    for row in (0, 3):
        alone = make(name, 1)
        alone.reset([0], state[row : row + 1])
        for action in actions:
            alone.step(action[row : row + 1])
        assert np.array_equal(alone.sim_state()[0], many.sim_state()[row])
        assert np.array_equal(alone.measured_state()[0], many.measured_state()[row])


def test_rows_that_are_not_active_keep_their_state_bit_for_bit():
    scene = make()
    grasp(scene, 10)
    before, seen = scene.sim_state(), scene.measured_state()
    scene.step(np.full((4, 7), 0.5), np.array([True, False, True, False]))
    assert np.array_equal(scene.sim_state()[[1, 3]], before[[1, 3]])
    assert np.array_equal(scene.measured_state()[[1, 3]], seen[[1, 3]])
    assert not np.array_equal(scene.sim_state()[[0, 2]], before[[0, 2]])


def test_a_reset_of_some_rows_leaves_the_others_alone():
    scene = make()
    grasp(scene, 10)
    before = scene.sim_state()
    start = scene.task.init_states("test", 2)
    scene.reset([3, 1], start)
    after = scene.sim_state()
    assert np.array_equal(after[[3, 1]], start) and np.array_equal(after[[0, 2]], before[[0, 2]])


@pytest.mark.parametrize("name", TASKS)
def test_fields_are_those_of_the_current_state_after_steps_and_resets(name):
    scene = make(name)
    grasp(scene, 12)
    scene.reset([2], scene.task.init_states("test", 1))
    data = mujoco.MjData(scene.model)
    for row, state in enumerate(scene.sim_state()):
        mujoco.mj_setState(scene.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(scene.model, data)
        assert np.allclose(scene.xpos[row], data.xpos, atol=1e-12)
        assert np.allclose(scene.site_xpos[row], data.site_xpos, atol=1e-12)
        assert np.allclose(scene.site_xmat[row].reshape(data.site_xmat.shape), data.site_xmat, atol=1e-12)
        assert np.allclose(scene.measured_state()[row, :3], data.site("panda/tcp").xpos, atol=1e-6)


@pytest.mark.parametrize("name", TASKS)
def test_an_image_is_what_mujoco_draws_of_the_row(name):
    scene = make(name, 3, cameras=("agentview", "wrist"), image_size=32, num_threads=2)
    grasp(scene, 6)
    rows = np.array([2, 0])
    images = scene.render(rows)
    data = mujoco.MjData(scene.model)
    model = copy.copy(scene.model)
    model.vis.quality.offsamples = 0
    with mujoco.Renderer(model, 64, 64) as renderer:  # means of 2 x 2 pixels
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for camera, full in (("agentview", "agentview"), ("wrist", "panda/wrist")):
            assert images[camera].shape == (2, 3, 32, 32) and images[camera].dtype == np.uint8
            for image, row in zip(images[camera], rows, strict=True):
                state = scene.sim_state()[row]
                mujoco.mj_setState(scene.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
                mujoco.mj_forward(scene.model, data)
                renderer.update_scene(data, full)
                drawn = renderer.render().reshape(32, 2, 32, 2, 3).mean((1, 3)).transpose(2, 0, 1)
                assert np.abs(drawn - image).max() <= 2
    scene.close()


def test_images_do_not_depend_on_the_number_of_threads():
    one, two = (make(n=5, cameras=("agentview",), num_threads=threads) for threads in (1, 2))
    assert np.array_equal(one.render()["agentview"], two.render()["agentview"])
    one.close(), two.close()


def test_the_burner_glows_in_the_rows_where_the_stove_is_on():
    scene = make("starter/turn_on_the_stove", 2, cameras=("agentview",))
    joint = scene.model.jnt_qposadr[scene.model.joint("stove_1/lever").id]
    state = scene.sim_state()
    scene.qpos[1, joint] = 1.4
    lit = scene.sim_state()
    scene.reset([0, 1], np.stack([state[1], lit[1]]))
    off, on = scene.render()["agentview"].astype(int)
    red = lambda image: int(((image[0] > 150) & (image[1] < 80)).sum())  # noqa: E731
    assert red(off) < 5 and red(on) > 60
    assert scene.success().tolist() == [False, True]
    scene.close()


def test_sizes_and_states_that_cannot_be_are_refused():
    task = load_task(TASKS[0])
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        SceneBatch(task, 0)
    with pytest.raises(ValueError, match="from 16 to 4096 px, got 8"):
        SceneBatch(task, 1, image_size=8)
    with pytest.raises(ValueError, match="unknown camera 'side'"):
        SceneBatch(task, 1, cameras=("side",))
    scene = make(n=2)
    with pytest.raises(ValueError, match="sim_state must be"):
        scene.reset([0], np.zeros((1, 3)))
    broken = scene.sim_state()[:1]
    broken[0, 5] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        scene.reset([0], broken)
