"""Processes that help to draw: the same pixels, and nothing lost or left behind when they or their parent end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from worldenv_trl.scenes import RendererPool, SceneBatch, load_task, rendering

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="looks into /proc")
STOVE, BOWL, DRAWER = (
    f"starter/{name}" for name in ("turn_on_the_stove", "put_the_bowl_on_the_plate", "open_the_top_drawer")
)


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    monkeypatch.setattr(rendering, "PAYS_AFTER", -1.0)
    monkeypatch.setattr(rendering, "_cores", lambda: 2)


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def children():
    return {int(pid) for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()}


def batch(name, rows, threads=2, **settings):
    task = load_task(name)
    scene = SceneBatch(task, rows, image_size=24, num_threads=threads, **settings)
    scene.reset(np.arange(rows), task.init_states("train", rows))
    return scene


def helped(scene):
    """Draws once, and waits until a helper is there."""
    scene.render()
    until(lambda: scene.drawing.pool.helpers)
    return scene.drawing.pool.helpers[0]


@pytest.fixture
def scene():
    scene = batch(BOWL, 6)
    yield scene
    scene.close()


def test_what_a_helper_draws_is_what_this_process_draws(monkeypatch):
    names, counts, cameras = (STOVE, BOWL, DRAWER, STOVE), (5, 4, 2, 1), ("agentview", "panda/wrist")
    alone, pool = RendererPool(1), RendererPool(2)
    rows, drawings = [], {alone: [], pool: []}
    for name, count in zip(names, counts, strict=True):
        scene = batch(name, count, 1, cameras=())
        if name == STOVE:
            scene.qpos[::2, scene.model.joint("stove_1/lever").qposadr[0]] = 1.5  # every other one glows
        rows.append(scene.poses())
        for painter, added in drawings.items():
            added.append(painter.add(scene.model, cameras, 24, count, scene.task.glows(scene.model)))
    expected = alone.render(drawings[alone], rows)
    lit, dark = expected[0]["agentview"][:2]
    assert (lit.astype(int) - dark)[0].max() > 100
    pool.render(drawings[pool], rows)
    until(lambda: pool.helpers)
    for taken_here in (True, False):  # whoever is faster, then all that may be by the helper
        if not taken_here:
            monkeypatch.setattr(rendering._Crew, "take", lambda crew: None)
        for order in (slice(None), slice(None, None, -1)):
            drawn = pool.render(drawings[pool][order], rows[order])
            for images, truth in zip(drawn, expected[order], strict=True):
                for camera in cameras:
                    assert np.array_equal(images[camera], truth[camera])
    alone.close(), pool.close()


def test_a_model_that_comes_later_and_rows_beyond_its_room_are_drawn_too(scene):
    helped(scene)
    pool, other = scene.drawing.pool, batch(DRAWER, 4, 1)
    expected, poses = other.render()["agentview"], other.poses()
    late = pool.add(other.model, ["agentview"], 24, 4)
    until(lambda: pool.helpers)
    twice = pool.render([late, scene.drawing, late], [poses, scene.poses(), poses[::-1]])
    assert np.array_equal(twice[0]["agentview"], expected)
    assert np.array_equal(twice[2]["agentview"], expected[::-1])
    other.close()


def test_a_helper_that_is_killed_costs_a_warning_and_no_image(scene, monkeypatch):
    expected = scene.render()["agentview"]
    pid = helped(scene)
    monkeypatch.setattr(rendering._Crew, "take", lambda crew: None)
    os.kill(pid, signal.SIGSTOP)
    finish = scene.drawing.pool.start([scene.drawing], [scene.poses()])
    os.kill(pid, signal.SIGKILL)
    with pytest.warns(RuntimeWarning, match="by this process alone from now on"):
        images = finish()[0]["agentview"]
    assert np.array_equal(images, expected)
    assert not Path(f"/proc/{pid}").exists()  # not even a zombie
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(scene.render()["agentview"], expected)
    assert scene.drawing.pool.helpers == []


@pytest.mark.parametrize("broken", ["no Python", "no GL"])
def test_a_helper_that_cannot_start_says_why_and_this_process_draws(scene, monkeypatch, broken):
    if broken == "no Python":
        monkeypatch.setattr(sys, "executable", "/nowhere/python")
    else:
        monkeypatch.setenv("MUJOCO_GL", "nonsense")

    def draw_until_it_is_noticed():
        expected = scene.render()["agentview"]
        while scene.drawing.pool._crew.size:
            assert np.array_equal(scene.render()["agentview"], expected)

    with pytest.warns(RuntimeWarning, match="nonsense" if broken == "no GL" else "/nowhere/python"):
        draw_until_it_is_noticed()


def test_closing_ends_the_helper_and_gives_back_every_descriptor():
    batch(BOWL, 4, 1).close()  # what GL opens once stays open
    before = set(os.listdir("/proc/self/fd"))
    scene = batch(BOWL, 4)
    pid = helped(scene)
    scene.close()
    assert not Path(f"/proc/{pid}").exists()
    assert set(os.listdir("/proc/self/fd")) <= before


def test_an_interrupted_caller_does_not_spoil_the_next_images(scene):
    expected = scene.render()["agentview"]
    helped(scene)
    backwards = scene.poses()[::-1]
    scene.drawing.pool.start([scene.drawing], [backwards])  # never finished
    assert np.array_equal(scene.render()["agentview"], expected)


def test_few_rows_one_thread_and_little_to_draw_start_no_process(monkeypatch):
    before = children()
    for rows, threads, after in ((2, 2, -1.0), (6, 1, -1.0), (6, 2, 100.0)):
        monkeypatch.setattr(rendering, "PAYS_AFTER", after)
        scene = batch(BOWL, rows, threads)
        for _ in range(3):
            scene.render()
        assert children() == before
        scene.close()


_SCRIPT = """
import sys, time, numpy as np
from worldenv_trl.scenes import SceneBatch, load_task, rendering
rendering.PAYS_AFTER, rendering._cores = -1.0, lambda: 2
task = load_task("starter/turn_on_the_stove")
scene = SceneBatch(task, 4, image_size=16)
scene.reset(np.arange(4), task.init_states("train", 4))
while not scene.drawing.pool.helpers:
    scene.render()
print(*scene.drawing.pool.helpers, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("end", ["kill", "exit"])
def test_a_helper_ends_with_its_parent_without_a_word(end):
    script = subprocess.Popen(
        [sys.executable, "-W", "error::ResourceWarning", "-c", _SCRIPT],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    pid = int(script.stdout.readline())
    assert alive(pid)
    if end == "kill":
        script.kill()
    said = script.communicate()
    until(lambda: not alive(pid), 10.0)
    assert said == ("", "")
    assert script.returncode == (-signal.SIGKILL if end == "kill" else 0)
