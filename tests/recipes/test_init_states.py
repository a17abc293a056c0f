"""Initial states are tried before they are stored."""

from __future__ import annotations

import numpy as np
import pytest

import init_states
from worldenv_trl.scenes import SceneBatch, load_task
from worldenv_trl.scenes.catalogue import SUITES_FOLDER
from worldenv_trl.scenes.initial import load_poses

TASK = "starter/put_the_bowl_on_the_plate"


def test_a_bowl_out_of_reach_is_refused_and_what_is_stored_is_solved():
    task = load_task(TASK)
    stored = task.init_states("test", 3)
    scene = SceneBatch(task, 3, cameras=())
    scene.reset(np.arange(3), stored)
    bowl = scene.model.jnt_qposadr[scene.model.body("bowl_1/").jntadr[0]]
    scene.qpos[1, bowl : bowl + 2] = 0.28, 0.34  # 94 cm from the base
    assert init_states.solved_by_expert(task, scene.sim_state()).tolist() == [True, False, True]
    assert init_states.solved_by_expert(task, stored).all()


def test_states_of_one_s_own_file_are_stored_beside_it(tmp_path, capsys):
    path = tmp_path / "mine.bddl"
    path.write_text((SUITES_FOLDER / "starter" / "turn_on_the_stove.bddl").read_text())
    init_states.main(init_states.Settings(tasks=(str(path),), count=2, processes=1))
    assert "mine.bddl: 2 + 2 states" in capsys.readouterr().out
    task = load_task(path)
    assert {split: len(poses) for split, poses in load_poses(task, task.states).items()} == {"train": 2, "test": 2}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tasks": ("goal/no_such",)}, "unknown task 'goal/no_such'"),
        ({"tasks": ("gaol",)}, "did you mean 'goal'"),
        ({"tasks": ("no_such.bddl",)}, "there is no task file no_such.bddl"),
        ({"count": 0}, "--count must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_drawn_is_named(settings, message):
    with pytest.raises(SystemExit, match=message):
        init_states.main(init_states.Settings(**settings))
