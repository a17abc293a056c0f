"""Suites, tasks and files on a command line, and numbers that cannot be."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import at_least, refusals
from config import WorldEnvConfig
from task_names import named_tasks, with_tasks
from worldenv_trl.scenes import list_tasks


def test_suites_tasks_and_files_are_taken_once_and_in_order():
    words = ["goal/turn_on_the_stove", "starter", "mine.bddl", "starter/open_the_top_drawer"]
    assert named_tasks(words) == ["goal/turn_on_the_stove", *list_tasks("starter"), "mine.bddl"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["gaol"], "'gaol' is no suite, and tasks are written suite/name: did you mean 'goal'"),
        (["open_the_middle_drawer"], "did you mean 'goal/open_the_middle_drawer'"),
        (["zzz"], "suites are spatial, object, goal, long, starter"),
        ([], "--tasks is empty"),
    ],
)
def test_a_word_that_is_none_of_them_is_answered_with_what_is_close(words, message):
    with pytest.raises(ValueError, match=message):
        named_tasks(words)


def test_a_run_of_a_suite_has_its_tasks(tmp_path, monkeypatch):
    words = ("goal/turn_on_the_stove", "starter", "a_demo.hdf5", "mine.bddl")
    found = with_tasks(WorldEnvConfig(tasks=words)).tasks
    assert found == ("goal/turn_on_the_stove", *list_tasks("starter"), "a_demo.hdf5", "mine.bddl")
    (tmp_path / "starter").mkdir()
    monkeypatch.chdir(tmp_path)
    assert with_tasks(WorldEnvConfig(tasks=("starter",))).tasks == tuple(list_tasks("starter"))
    with pytest.raises(ValueError, match="the folder starter, which holds no file of LIBERO's"):
        with_tasks(WorldEnvConfig(tasks=("./starter",)))
    with pytest.raises(ValueError, match="did you mean 'goal'"):
        with_tasks(WorldEnvConfig(tasks=("gaol",)))


def test_numbers_that_are_too_small_are_named_like_their_options():
    at_least(1, rows=(1, 2), repeats=1)
    with pytest.raises(ValueError, match="--image-sizes must be at least 16, got 8"):
        at_least(16, image_sizes=(64, 8))
    with pytest.raises(ValueError, match="--rows is empty"):
        at_least(1, rows=())


def test_other_errors_keep_their_traceback():
    with pytest.raises(SystemExit, match=r"error: .*no such file"), refusals():
        Path("no such file").read_text()
    with pytest.raises(KeyError), refusals():
        raise KeyError("a mistake of ours")
