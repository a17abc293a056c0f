"""What settings allow and is seldom meant is said, and is no error."""

from __future__ import annotations

from dataclasses import replace

import pytest

from checks import doubts
from config import PRESETS, Adapt, WorldEnvConfig
from stages import open_run
from world_env import main


def test_steps_that_nothing_reads_are_said_to_be_unread(tmp_path, capsys):
    open_run(WorldEnvConfig(run_dir=tmp_path / "run", adapt=Adapt(steps=0, correct_steps=5))).close()
    assert "warning: adapt.correct_steps=5 is not read: adapt.steps is 0" in capsys.readouterr().err


def test_rollouts_shorter_than_a_suite_allows_are_said_with_the_number_of_whole_chunks():
    config = WorldEnvConfig(tasks=("starter/open_the_top_drawer", "goal/turn_on_the_stove"))
    (line,) = doubts(config)
    assert line == "max_steps=72 ends rollouts before the 150 steps of goal/turn_on_the_stove: --max-steps 152"
    assert not doubts(replace(config, max_steps=152))


@pytest.mark.parametrize("preset", PRESETS)
def test_no_preset_is_in_doubt(preset):
    assert not doubts(PRESETS[preset][1])


def test_a_plan_says_it_too(tmp_path, capsys):
    arguments = ["smoke", "--run-dir", str(tmp_path / "run"), "--tasks", "object", "--dry-run"]
    assert main(arguments) == 0
    assert "warning: max_steps=72 ends rollouts before the 120 steps of object/" in capsys.readouterr().out
