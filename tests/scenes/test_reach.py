"""What is said to be out of reach is where the controller's arm does not get to, and nothing else is."""

from __future__ import annotations

import numpy as np

from worldenv_trl.robot import panda
from worldenv_trl.scenes import controller
from worldenv_trl.scenes.reach import out_of_reach


def test_the_controller_misses_a_point_by_what_lies_beyond_its_reach():
    rng = np.random.default_rng(0)
    goals = rng.uniform(panda.WORKSPACE_LOW, panda.WORKSPACE_HIGH, (300, 3))
    angles = np.repeat(panda.HOME_Q[None], len(goals), 0)
    targets = controller.reset_targets(angles, np.ones(len(goals)))
    targets[:, :3] = goals
    for _ in range(150):
        angles = controller.joint_targets(angles, targets)
    missed = np.linalg.norm(controller.forward_kinematics(angles)[0] - goals, axis=-1)
    beyond = out_of_reach(goals)
    assert (beyond > 0.05).sum() > 20 and (beyond == 0).sum() > 100
    assert missed[beyond == 0].max() < 1e-3  # it creeps to points at the very edge
    # A hand that cannot get there tilts a little towards it.
    np.testing.assert_allclose(missed[beyond > 0], beyond[beyond > 0], rtol=0.1, atol=2e-3)


def test_targets_are_not_commanded_beyond_the_workspace():
    points = np.array([[-0.30, 0.0, 0.2], [0.0, 0.45, 0.2], [0.0, 0.38, 0.49], [0.0, 0.0, 0.1]])
    np.testing.assert_allclose(out_of_reach(points), [0.05, 0.10, 0.05, 0.0])
