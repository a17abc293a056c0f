"""Supersampled images against plain block means, and against finely sampled ones."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from worldenv_trl.scenes import SceneBatch, load_task
from worldenv_trl.scenes.rendering import SUPERSAMPLING, _shrunk


def test_shrinking_takes_the_rounded_mean_of_each_block():
    frame = np.random.default_rng(0).integers(0, 256, (12, 8, 3), dtype=np.uint8)
    k = SUPERSAMPLING
    means = frame.reshape(12 // k, k, 8 // k, k, 3).mean((1, 3))
    assert np.array_equal(_shrunk(frame), np.floor(means + 0.5).astype(np.uint8))


def test_edges_are_smooth_and_everything_is_where_it_belongs():
    task = load_task("starter/turn_on_the_stove")
    scene = SceneBatch(task, 1, num_threads=1)
    scene.reset(np.array([0]), task.init_states("train", 1))
    image = scene.render()["agentview"][0].transpose(1, 2, 0).astype(float)

    def drawn(size: int) -> np.ndarray:
        model = copy.copy(task.build())
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = size
        renderer, data = mujoco.Renderer(model, size, size), mujoco.MjData(model)
        data.qpos[:], data.mocap_pos[:] = scene.qpos[0], scene.batch.bind("mocap_pos")[0]
        mujoco.mj_forward(model, data)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        renderer.update_scene(data, "agentview")
        frame = renderer.render().astype(float)
        renderer.close()
        return frame.reshape(64, size // 64, 64, size // 64, 3).mean((1, 3))

    truth, jagged = drawn(512), drawn(64)
    scene.close()
    assert np.abs(image - truth).mean() < 0.6 * np.abs(jagged - truth).mean()
    assert np.abs(image - truth).mean() < 1.0
