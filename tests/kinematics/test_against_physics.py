"""Forward kinematics over whole expert episodes, and the proprioception of imagination and physics side by side."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import torch

from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.scenes import SceneBatch, list_tasks, load_task
from worldenv_trl.scenes.expert import ScriptedExpert

FK = ForwardKinematics()
ROWS = 8
TASKS = list_tasks("starter")


@lru_cache
def episodes(name: str):
    """Expert episodes [n, T]: kinematic, measured and commanded states [n, T + 1, .], actions and what was executed."""
    task = load_task(name)
    scene = SceneBatch(task, ROWS, cameras=(), num_threads=1)
    scene.reset(np.arange(ROWS), task.init_states("train", ROWS))
    expert = ScriptedExpert(task)
    expert.reset(np.arange(ROWS))
    states, measured, commanded = [scene.kinematic_state()], [scene.measured_state()], [scene.commanded_state()]
    actions, running = [], []
    active = np.ones(ROWS, bool)
    for _ in range(task.max_steps):
        action = expert(scene)
        scene.step(action, active)
        actions.append(action)
        running.append(active)
        states.append(scene.kinematic_state())
        measured.append(scene.measured_state())
        commanded.append(scene.commanded_state())
        active = active & ~scene.success()
    assert not active.all(), "the expert solved nothing: the episodes say nothing"

    def stacked(arrays):
        return torch.as_tensor(np.stack(arrays, 1)).float()

    return stacked(states), stacked(measured), stacked(commanded), stacked(actions), stacked(running).bool()


def test_open_loop_predictions_stay_within_millimetres_of_the_physics():
    errors = []
    for name in TASKS:
        states, measured, _, actions, running = episodes(name)
        predicted = FK.pose(FK.rollout(states[:, 0], actions))[..., :3]
        errors.append((predicted - measured[:, 1:, :3]).norm(dim=-1)[running])
    per_task = {name: f"{1e3 * error.mean():.1f} mm" for name, error in zip(TASKS, errors, strict=True)}
    assert torch.cat(errors).mean() < 0.003, per_task


@pytest.mark.parametrize("name", TASKS)
def test_the_commanded_state_is_the_same_number_in_imagination_and_physics(name):
    states, _, commanded, actions, running = episodes(name)
    predicted = FK.state(FK.rollout(states[:, 0], actions), "commanded")
    position_and_opening = [0, 1, 2, 6]
    difference = (predicted - commanded[:, 1:])[running][:, position_and_opening]
    assert difference.abs().max() < 1e-5


@pytest.mark.parametrize("name", TASKS)
def test_the_measured_joints_give_the_measured_pose(name):
    states, measured, _, _, _ = episodes(name)
    assert (FK.pose(states)[..., :3] - measured[..., :3]).abs().max() < 1e-5
