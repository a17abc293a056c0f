"""Initial states are tried before they are stored."""

from __future__ import annotations

import numpy as np
import pytest

import init_states
from worldenv_trl.scenes import SceneBatch, load_task
from worldenv_trl.scenes.catalogue import SUITES_FOLDER
from worldenv_trl.scenes.initial import draw_poses, load_poses, states_from_poses

TASK = "goal/open_the_top_drawer_and_put_the_bowl_inside"


def test_a_bowl_out_of_reach_is_refused_and_what_is_stored_is_solved():
    task = load_task(TASK)
    first_draws = states_from_poses(task, draw_poses(task, "test", 31, 2))
    stored = task.init_states("test")[31:33]
    assert not np.array_equal(first_draws[0], stored[0])  # refused when they were made
    assert np.array_equal(first_draws[1], stored[1])
    scene = SceneBatch(task, 1, cameras=())
    scene.reset(np.arange(1), first_draws[:1])
    bowl = scene.model.jnt_qposadr[scene.model.body("bowl_1/").jntadr[0]]
    scene.qpos[0, bowl : bowl + 2] = 0.28, 0.34  # 94 cm from the base
    with pytest.warns(UserWarning, match="out of the arm's reach"):
        solved = init_states.solved_by_expert(task, np.concatenate([scene.sim_state(), stored]))
    assert solved.tolist() == [False, True, True]


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
