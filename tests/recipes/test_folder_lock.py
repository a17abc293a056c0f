"""Two runs on one folder."""

from __future__ import annotations

import dataclasses
import gc
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import folder_lock
from config import PRESETS
from folder_lock import lock_folder
from run_folder import RunFolder
from stages import open_run

HOLD = (
    "import sys; from pathlib import Path; from folder_lock import lock_folder; lock = lock_folder(Path(sys.argv[1])); "
)


def other_process(folder: Path, then: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(Path(folder_lock.__file__).parent)}
    arguments = [sys.executable, "-c", HOLD + then, str(folder)]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen(arguments, **pipes, text=True, env=environment)


@pytest.fixture
def held(tmp_path):
    """A folder in which another process runs, and that process."""
    folder = tmp_path / "run"
    folder.mkdir()
    process = other_process(folder, "print('held', flush=True); sys.stdin.read()")
    assert process.stdout.readline() == "held\n"
    yield folder, process
    process.kill()
    process.communicate()


def test_a_second_run_is_refused_in_one_line_and_changes_nothing(held):
    folder, process = held
    config = dataclasses.replace(PRESETS["smoke"][1], run_dir=folder)
    message = (
        f"error: {folder} is in use by process {process.pid}: wait until it has ended, or choose another --run-dir"
    )
    with pytest.raises(SystemExit) as refused:
        open_run(config)
    assert str(refused.value) == message
    assert [path.name for path in folder.iterdir()] == ["run.lock"]


def test_the_folder_is_free_when_the_process_is_killed(held):
    folder, process = held
    process.send_signal(signal.SIGKILL)
    process.wait()
    RunFolder(folder).open(PRESETS["smoke"][1])


def test_a_process_may_open_its_folder_again_and_others_may_when_it_is_done(tmp_path):
    first, second = (lock_folder(tmp_path) for _ in range(2))
    assert first is second
    del first
    gc.collect()
    refused = other_process(tmp_path, "pass")
    assert refused.wait() == 1 and f"is in use by process {os.getpid()}: wait" in refused.communicate()[1]
    del second
    gc.collect()
    assert other_process(tmp_path, "pass").wait() == 0


def test_reading_needs_no_lock(held):
    assert RunFolder(held[0]).read_metrics() == []
