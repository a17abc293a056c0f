"""What users bring at full size, tiny: a vision-language policy, a LLaVA reflector and a diffusers world model, through
the one recipe."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

sys.path.extend(str(Path(__file__).parents[1] / name) for name in ("world_models", "reflectors"))

from safetensors import safe_open
from small_diffusion import SMALL
from test_recipe import VISION_LANGUAGE
from tiny_vlm import save_tiny_vlm

from parts import COMPACT, Part, cameras_of, instructions
from run_folder import RunFolder
from stages import plan
from world_env import run_all
from worldenv_trl.record import read_metadata
from worldenv_trl.reflectors import VLMLessons, VLMReflector, VLMReflectorConfig
from worldenv_trl.world_models import DiffusionWorldModel, DiffusionWorldModelConfig


def make_world_model(config) -> DiffusionWorldModel:
    sizes = {"image_size": config.image_size, "chunk_length": config.chunk_length, "num_denoise_steps": 1}
    return DiffusionWorldModel(DiffusionWorldModelConfig.for_cameras(cameras_of(config), **{**SMALL, **sizes}))


@pytest.mark.parametrize("cameras", [("agentview",), ("agentview", "wrist")])
def test_the_whole_loop_runs_with_real_parts(tiny, capsys, monkeypatch, tmp_path, cameras):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    folder = str(save_tiny_vlm(tmp_path / "llava"))

    def make_reflector(config) -> VLMReflector:
        settings = VLMReflectorConfig(folder, instructions(config), num_frames=4, score_every=4)
        return VLMReflector(settings, VLMLessons(epochs=1, prefixes_per_episode=3, holdout=0.2, calibration_steps=2))

    parts = dataclasses.replace(
        COMPACT,
        policy=VISION_LANGUAGE,
        world_model=Part(make_world_model, DiffusionWorldModel.from_pretrained),
        reflector=Part(make_reflector, VLMReflector.from_pretrained),
    )
    config = dataclasses.replace(tiny, cameras=cameras)
    run_all(config, parts)
    run = RunFolder(config.run_dir)
    assert all(run.done(stage.name) for stage in plan(config))
    told = capsys.readouterr()
    assert "missing in the report" not in told.out and "the report could not be written" not in told.err
    recorded = read_metadata(run.rollouts("post_train_000"))
    assert set(recorded["models"]) == {"policy", "world_model", "reflector"}
    learned = run.read_metrics("reflector")
    assert any("head_loss" in line for line in learned)
    with safe_open(run.checkpoint("reflector") / "model.safetensors", "pt") as weights:
        assert not any(name.startswith("vlm.") for name in weights.keys())  # noqa: SIM118 - no dict
