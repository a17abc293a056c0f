"""One place sets how many threads a command computes with."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import threads
from stages import open_run
from worldenv_trl.envs import TabletopEnv

RECIPES = Path(threads.__file__).parent


@pytest.fixture(autouse=True)
def as_before(monkeypatch):
    before = torch.get_num_threads()
    for name in threads.VARIABLES:
        monkeypatch.setenv(name, os.environ.get(name, "1"))
    yield
    torch.set_num_threads(before)


def test_torch_the_scenes_and_the_processes_of_a_command_take_the_number():
    for count in (1, 2):
        threads.use_threads(count)
        assert torch.get_num_threads() == count
        asked = [sys.executable, "-c", "import torch; print(torch.get_num_threads())"]
        told = subprocess.check_output(asked, text=True)
        assert int(told) == count
        env = TabletopEnv(["starter/open_the_top_drawer", "starter/turn_on_the_stove"], 2, cameras=(), seed=0)
        assert (env._executor is not None) == (count == 2)
        env.close()


def test_a_run_computes_with_the_threads_of_its_settings(tiny):
    threads.use_threads(1)
    open_run(dataclasses.replace(tiny, num_threads=2))
    assert torch.get_num_threads() == 2


def test_less_than_one_is_refused():
    with pytest.raises(ValueError, match="--num-threads must be at least 1, got 0"):
        threads.use_threads(0)


def test_many_more_than_there_are_cores_for_are_refused_before_the_folder_is_made(tiny):
    with pytest.raises(SystemExit, match=r"--num-threads must be at most \d+ on this machine of .* 5000"):
        open_run(dataclasses.replace(tiny, num_threads=5000))
    assert not tiny.run_dir.exists()


def test_nothing_else_sets_them():
    setting = re.compile(r"set_num_threads\(|environ.*NUM_THREADS|(?<!get_)num_threads=\d")
    found = {
        f"{path.relative_to(RECIPES)}: {line.strip()}"
        for path in RECIPES.rglob("*.py")
        for line in path.read_text().splitlines()
        if setting.search(line) and path.name != "threads.py"
    }
    # Many processes of a scene each, in which torch has nothing to do.
    assert {each.partition(":")[0] for each in found} == {"init_states.py"}
