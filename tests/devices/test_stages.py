"""Every stage of the loop on a GPU, the physics on the CPU."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

import checks
import run
from gather_evidence import gather
from replay import Options
from replay import main as replay_main
from world_env import run_all
from worldenv_trl.devices import choose_device
from worldenv_trl.record import read_metadata
from worldenv_trl.report import RunRecord


@pytest.fixture
def on_gpu(gpu, monkeypatch):
    """Makes the settings' ``cuda`` mean the device, stand-in or not."""
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    for module in (checks, run):
        monkeypatch.setattr(module, "choose_device", lambda name: gpu if name == "cuda" else choose_device(name))
    return gpu


def test_the_whole_loop_and_a_replay_of_it(tiny, on_gpu, monkeypatch):
    sampled = dataclasses.replace(tiny.world_model, deterministic=False, denoise_steps=2)
    config = dataclasses.replace(tiny, device="cuda", world_model=sampled)
    run_all(config)
    stages = {json.loads(line)["stage"] for line in (tiny.run_dir / "metrics.jsonl").read_text().splitlines()}
    assert {"sft", "explore", "world_model", "reflector", "post_train", "evaluate"} <= stages
    waves = tiny.run_dir / "rollouts" / "post_train_000.mcap"
    assert read_metadata(waves)["device"] == "cuda"

    monkeypatch.setattr("replay.choose_device", lambda name: on_gpu)
    assert replay_main(Options(file=waves, rollout=1, reflector="recorded")) == 0
    physics = tiny.run_dir / "rollouts" / "explore.mcap"
    assert replay_main(Options(file=physics, policy="sft", from_step=4, reflector="recorded")) == 0

    monkeypatch.setattr("gather_evidence.choose_device", lambda name: on_gpu)
    evidence = gather(RunRecord.read(tiny.run_dir), 1, 1, 1, device="cuda")
    assert evidence.episodes == 1 and not evidence.missing


def test_a_run_is_continued_on_another_device(tiny):
    from run_folder import RunFolder

    RunFolder(tiny.run_dir).open(dataclasses.replace(tiny, device="cuda:3"))
    RunFolder(tiny.run_dir).open(dataclasses.replace(tiny, device="cpu"))


def test_the_physics_learns_on_a_gpu(tiny, on_gpu):
    from demonstrate import demonstrate
    from post_train import post_train
    from run import Run
    from run_folder import RunFolder
    from sft import fine_tune

    settings = dataclasses.replace(tiny.post_train, env="tabletop")
    config = dataclasses.replace(tiny, device="cuda", post_train=settings)
    folder = RunFolder(config.run_dir)
    folder.open(config)
    there = Run(config, folder)
    demonstrate(there)
    fine_tune(there)
    post_train(there, source="sft", target="post_train", models="")
    assert there.policy("post_train").action_range.device.type == "cuda"
    assert torch.get_default_device().type == "cpu"
