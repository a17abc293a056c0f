"""What the speeds of the benchmarks are made of."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from speeds import core_seconds, drawing_yardstick, flops, matmul_bound, physics_yardstick, speed
from worldenv_trl.scenes import load_task


def test_waiting_costs_seconds_and_no_core_seconds():
    measured = speed(lambda: time.sleep(0.05) or 1.0, repeats=2)
    assert len(measured.per_second) == 2 and measured.wall <= 20
    assert measured.core > 5 * measured.wall


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="helpers are seen in Linux's /proc")
def test_processor_time_of_helpers_counts():
    before, own = core_seconds(), time.process_time()
    busy = "import time\nwhile time.process_time() < 1: pass\ntime.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", busy]) as helper:
        while core_seconds() - before - (time.process_time() - own) < 0.5:
            time.sleep(0.02)
            assert helper.poll() is None, "the helper ended before it was seen"
        helper.kill()


def test_products_and_convolutions_are_counted():
    first, second = torch.zeros(3, 4), torch.zeros(4, 5)
    assert flops(lambda: first @ second) == 2 * 3 * 4 * 5
    layer, image = torch.nn.Conv2d(2, 6, 3, padding=1), torch.zeros(1, 2, 8, 8)
    assert flops(lambda: layer(image)) == 2 * 6 * 2 * 9 * 64
    assert flops(lambda: layer(image).sum().backward()) == 2 * 2 * 6 * 2 * 9 * 64  # and of the weights' gradient


def test_the_yardsticks_of_a_scene_are_measured():
    task = load_task("starter/open_the_top_drawer")
    assert physics_yardstick(task, 1, steps=5).core > 0
    assert drawing_yardstick(task, "agentview", 32, 1, frames=2).core > 0
    assert matmul_bound(torch.device("cpu"), torch.float32, 1, size=32).core > 0
