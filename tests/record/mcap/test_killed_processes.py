"""Processes that are killed while they record; ``recipes/benchmarks/kill.py`` does the same more often."""

from __future__ import annotations

import pytest

from benchmarks import kill
from worldenv_trl.record import read_rollouts


def test_a_killed_recorder_has_lost_nothing_that_was_flushed_or_a_second_old(tmp_path):
    found = kill.kill_recorders(3, tmp_path, rows=2, within=1.5)
    assert found.flushed > 20 and found.lost == 0
    assert found.old_lost == 0 and max(found.seconds) < 1


def test_a_killed_writer_has_lost_no_write_that_returned(tmp_path):
    found = kill.kill_writers(2, tmp_path)
    assert found.flushed > 2 and found.lost == 0


def test_a_killed_recording_does_not_take_the_place_of_the_whole_one(tmp_path):
    kill.killed(kill.write_rollouts, tmp_path / "a.mcap", 0, 0.05)
    with pytest.raises(FileNotFoundError, match=r"unfinished recording is in .*a_killed\.partial\.mcap"):
        read_rollouts(tmp_path / "a_killed.mcap")
