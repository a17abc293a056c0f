"""What SFT learns from: demonstrations, moved over the table where that is asked for."""

from __future__ import annotations

import dataclasses
import json
from functools import partial

import pytest
import torch
from small_run import SMALL

import config
import sft
from demonstrate import demonstrate
from episodes import demonstrations
from stages import open_run
from worldenv_trl import keys
from worldenv_trl.data import policy_samples
from worldenv_trl.policies import OFTPolicy, SceneShift
from worldenv_trl.scenes import load_task

TASKS = config.GOAL_TASKS[1:]


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    learned = dataclasses.replace(SMALL.sft, scene_shift_m=0.05, steps=4, scale_steps=1)
    run = open_run(dataclasses.replace(SMALL, run_dir=tmp_path / "run", tasks=TASKS, sft=learned))
    demonstrate(run)
    return run


def test_scene_and_hand_are_moved_at_the_height_where_each_task_takes_hold(run, monkeypatch):
    made, moved = [], []

    class Watched(SceneShift):
        def __init__(self, cameras, reach, *, height):
            made.append((sorted(cameras), reach, height))
            super().__init__(cameras, reach, height=height)

        def __call__(self, samples):
            out = super().__call__(samples)
            moved.append((out[keys.STATE] - samples[keys.STATE]).abs())
            return out

    monkeypatch.setattr(sft, "SceneShift", Watched)
    sft.fine_tune(run)
    samples = policy_samples(demonstrations(run))
    lowest = {}
    for row in range(len(samples)):
        text, z = samples[row][keys.INSTRUCTION], samples[row][keys.STATE][2].item()
        lowest[text] = min(z, lowest.get(text, z))
    assert set(lowest) == {load_task(task).language for task in TASKS}
    assert made == [(["agentview"], 0.05, lowest)] * 2  # the means' lesson, then the scale's
    distance = torch.cat(moved)
    assert len(moved) == 5 and distance[:, 2:].max() == 0 and 0.03 < distance[:, :2].max() <= 0.05 + 1e-6
    assert 0.5 < (distance.amax(1) > 0).float().mean() < 0.9  # seven of ten


def test_without_it_nothing_is_moved(run, monkeypatch):
    monkeypatch.setattr(sft, "SceneShift", lambda *_, **__: pytest.fail("made"))
    still = dataclasses.replace(run.config.sft, scene_shift_m=0.0)
    sft.fine_tune(dataclasses.replace(run, config=dataclasses.replace(run.config, sft=still)))


def test_beside_the_actions_it_is_taught_where_to_aim(run):
    aimed = dataclasses.replace(run.config.sft, aim_weight=0.5, shift_px=0, steps=60)
    sft.fine_tune(dataclasses.replace(run, config=dataclasses.replace(run.config, sft=aimed)))
    logged = [json.loads(line) for line in run.folder.metrics_path.read_text().splitlines()]
    far = {line["step"]: line["aim"] for line in logged if "aim" in line}
    assert list(far) == [0, 50, 59] and far[59] < far[0] / 2  # the means' lesson alone


def test_a_policy_that_does_not_aim_learns_its_actions_alone(run, monkeypatch):
    class Aimless(OFTPolicy):
        aiming = None

    monkeypatch.setattr("parts.OFTPolicy", Aimless)
    aimed = dataclasses.replace(run.config.sft, aim_weight=0.5, shift_px=0)
    with pytest.warns(UserWarning, match=r"Aimless does not say where it aims: it learns actions alone"):
        sft.fine_tune(dataclasses.replace(run, config=dataclasses.replace(run.config, sft=aimed)))
    assert "aim" not in run.folder.metrics_path.read_text()


def test_places_are_moved_before_the_scene(run, monkeypatch):
    order = []

    def making(name, cameras, reach, **_):
        return lambda samples: order.append((name, reach)) or samples

    for name in ("SceneShift", "PlaceShift"):
        monkeypatch.setattr(sft, name, partial(making, name))
    both = dataclasses.replace(run.config.sft, place_shift_m=0.02, steps=1)
    sft.fine_tune(dataclasses.replace(run, config=dataclasses.replace(run.config, sft=both)))
    assert order == [("PlaceShift", 0.02), ("SceneShift", 0.05)] * 2  # the means' lesson, then the scale's


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_each_batch_comes_from_where_chunks_begin(run, monkeypatch, share):
    drawn = []
    monkeypatch.setattr(sft, "SceneShift", lambda *_, **__: lambda samples: drawn.append(samples) or samples)
    settings = dataclasses.replace(run.config.sft, decision_share=share, steps=40, batch_size=64)
    sft.fine_tune(dataclasses.replace(run, config=dataclasses.replace(run.config, sft=settings)))
    steps = torch.cat([samples[keys.NUM_STEPS] for samples in drawn]).squeeze(-1)
    every = policy_samples(demonstrations(run))[keys.NUM_STEPS].squeeze(-1)
    begins = (every % run.config.chunk_length == 0).float().mean()
    expected = share + (1 - share) * begins
    spread = (expected * (1 - expected) / len(steps)).sqrt()
    assert ((steps % run.config.chunk_length == 0).float().mean() - expected).abs() <= 4 * spread
