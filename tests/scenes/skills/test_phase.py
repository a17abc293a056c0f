"""Which of the two ways the hand turns to lay its fingers along a line."""

from __future__ import annotations

import numpy as np
import pytest

from worldenv_trl.scenes import SceneBatch, ScriptedExpert, load_task
from worldenv_trl.scenes.skills.phase import wrist_yaw


@pytest.mark.parametrize("middle", [0.0, np.pi / 2, -np.pi / 2, np.pi])
def test_things_that_lie_nearly_alike_are_met_by_yaws_that_are_nearly_alike(middle):
    wanted = middle + np.linspace(-0.7, 0.7, 57)
    yaw = wrist_yaw(wanted, np.zeros(57))
    np.testing.assert_allclose(np.diff(yaw), np.diff(wanted), atol=1e-9)  # no jump by half a turn
    np.testing.assert_allclose(np.sin(yaw - wanted), 0.0, atol=1e-9)  # the same line
    assert (yaw > -np.pi / 4).all() and (yaw < 3 * np.pi / 4).all()


def test_a_yaw_that_the_hand_nearly_has_is_kept_beyond_the_middle_of_its_range():
    wanted = np.array([-0.9, -0.9, 2.5, 2.5])
    np.testing.assert_allclose(
        wrist_yaw(wanted, np.array([-0.7, 0.0, 2.3, 0.0])), [-0.9, np.pi - 0.9, 2.5, 2.5 - np.pi]
    )


def test_a_hand_that_follows_a_line_all_the_way_round_stays_within_the_wrist():
    yaw = np.zeros(1)
    for wanted in np.linspace(0.0, 4 * np.pi, 200):
        yaw = wrist_yaw(np.array([wanted]), yaw)
        np.testing.assert_allclose(np.sin(yaw - wanted), 0.0, atol=1e-9)
        assert -np.pi / 4 - 0.3 < yaw.item() < 3 * np.pi / 4 + 0.3


@pytest.mark.parametrize(
    "name", ["goal/put_the_cream_cheese_in_the_bowl", "long/put_the_book_in_the_caddy_and_the_mug_on_the_plate"]
)
def test_the_expert_turns_its_hand_the_same_way_in_every_state(name):
    task, rows = load_task(name), 50
    scene = SceneBatch(task, rows, cameras=(), num_threads=1)
    scene.reset(np.arange(rows), task.init_states("train", rows))
    turns = ScriptedExpert(task)(scene)[:, 5]
    assert (turns > 0.1).all()
