"""Images against MuJoCo's own renderer pixel for pixel, and supersampled ones against finely sampled ones."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest

from worldenv_trl.scenes import RendererPool, SceneBatch, ScriptedExpert, list_tasks, load_task
from worldenv_trl.scenes.canvas import SUPERSAMPLING

CAMERAS = {"agentview": "agentview", "wrist": "panda/wrist"}


def plain_renderer(model, size):
    """MuJoCo's own, without multisampling, shadows and reflections."""
    model = copy.copy(model)
    model.vis.quality.offsamples = 0
    model.vis.global_.offwidth = model.vis.global_.offheight = size
    renderer = mujoco.Renderer(model, size, size)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    return renderer, model


def block_means(frame, k=SUPERSAMPLING):
    size = len(frame) // k
    return np.floor(frame.reshape(size, k, size, k, 3).mean((1, 3)) + 0.5).astype(np.uint8).transpose(2, 0, 1)


@pytest.mark.parametrize("name", list_tasks("starter"))
def test_every_pixel_is_the_mean_of_what_mujoco_draws(name):
    task = load_task(name)
    scene = SceneBatch(task, 3, image_size=48, cameras=tuple(CAMERAS), num_threads=1)
    scene.reset(np.arange(3), task.init_states("train", 3))
    renderer, model = plain_renderer(scene.model, 96)
    data, expert = mujoco.MjData(model), ScriptedExpert(task)
    for step in range(30):
        scene.step(expert(scene))
        if step % 6:
            continue
        images = scene.render()
        for row in range(3):
            scene.load(data, row)
            mujoco.mj_forward(model, data)
            for glow in task.glows(model):
                glow.apply(model, data.qpos)
            for short, full in CAMERAS.items():
                renderer.update_scene(data, full)
                assert np.array_equal(images[short][row], block_means(renderer.render())), (step, row, short)
    renderer.close(), scene.close()


def test_a_pool_draws_several_models_of_any_number_of_rows_as_each_alone():
    tasks, counts = [load_task(name) for name in list_tasks("starter")], (5, 1, 2)  # shared by the threads, and not
    pool, alone, poses = RendererPool(2), [], []
    drawings = []
    for task, count in zip(tasks, counts, strict=True):
        scene = SceneBatch(task, count, image_size=32, num_threads=1)
        scene.reset(np.arange(count), task.init_states("test", count))
        alone.append(scene.render()["agentview"]), poses.append(scene.poses())
        drawings.append(pool.add(scene.model, ["agentview"], 32, count, task.glows(scene.model)))
        scene.close()
    for _ in range(3):
        for images, expected in zip(pool.render(drawings, poses), alone, strict=True):
            assert np.array_equal(images["agentview"], expected)
    backwards = pool.render(drawings[::-1], poses[::-1])
    assert np.array_equal(backwards[0]["agentview"], alone[2])
    pool.close()


def test_what_goes_wrong_on_a_thread_is_raised_here_and_the_pool_draws_on():
    task = load_task("starter/open_the_top_drawer")
    scene = SceneBatch(task, 4, image_size=16, num_threads=2)
    scene.reset(np.arange(4), task.init_states("train", 4))
    before = scene.render()["agentview"]
    poses = scene.poses()
    with pytest.raises(ValueError):
        scene.drawing.render([*poses[:3], (np.zeros(2), *poses[3][1:])])
    assert np.array_equal(scene.render()["agentview"], before)
    scene.close()


def test_edges_are_smooth_and_everything_is_where_it_belongs(monkeypatch):
    task = load_task("starter/turn_on_the_stove")
    plain = copy.copy(task.build())
    plain.geom_matid[:] = -1  # edges, not the grain of the table
    monkeypatch.setattr(type(task), "build", lambda task: plain)
    scene = SceneBatch(task, 1, num_threads=1)
    scene.reset(np.array([0]), task.init_states("train", 1))
    image = scene.render()["agentview"][0].transpose(1, 2, 0).astype(float)

    def drawn(size: int) -> np.ndarray:
        renderer, model = plain_renderer(scene.model, size)
        data = mujoco.MjData(model)
        scene.load(data, 0)
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, "agentview")
        frame = renderer.render().astype(float)
        renderer.close()
        return frame.reshape(64, size // 64, 64, size // 64, 3).mean((1, 3))

    truth, jagged = drawn(512), drawn(64)
    scene.close()
    assert np.abs(image - truth).mean() < 0.6 * np.abs(jagged - truth).mean()
    assert np.abs(image - truth).mean() < 1.0
