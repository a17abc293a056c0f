"""One recipe, other parts: each is swapped by passing another object, and nothing else changes."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from colour_reflector import ColourConfig, ColourReflector
from copying_world_model import CopyingConfig, CopyingWorldModel
from mlp_policy import MLPConfig, MLPPolicy
from policies import hf_models

from parts import COMPACT, Part, instructions
from run_folder import RunFolder
from stages import plan
from world_env import run_all
from worldenv_trl.policies import HFConfig, HFPolicy
from worldenv_trl.record import read_metadata


def mlp(config) -> MLPPolicy:
    seen = {"image_size": config.image_size, "chunk_length": config.chunk_length, "cameras": config.cameras}
    return MLPPolicy(MLPConfig(instructions=instructions(config), **seen))


def copying(config) -> CopyingWorldModel:
    seen = {"image_size": config.image_size, "chunk_length": config.chunk_length, "cameras": config.cameras}
    return CopyingWorldModel(CopyingConfig(**seen))


def vision_language(config) -> HFPolicy:
    network = hf_models.backbone("smolvlm").to_dict()
    seen = {"image_size": config.image_size, "chunk_length": config.chunk_length, "cameras": config.cameras}
    settings = HFConfig(
        backbone=network,
        instructions=instructions(config),
        lora_rank=config.post_train.lora_rank,
        dtype="bfloat16",
        gradient_checkpointing=True,
        **seen,
    )
    return HFPolicy(settings, hf_models.tokenizer())


OTHERS = {
    "policy": Part(mlp, MLPPolicy.from_pretrained),
    "world_model": Part(copying, CopyingWorldModel.from_pretrained),
    "reflector": Part(
        lambda config: ColourReflector(ColourConfig(cameras=config.cameras)), ColourReflector.from_pretrained
    ),
}


VISION_LANGUAGE = Part(vision_language, HFPolicy.from_pretrained)


@pytest.fixture(autouse=True)
def forgiving_expert(monkeypatch):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert


@pytest.mark.parametrize(
    ("swapped", "cameras"),
    [(("policy",), ("agentview",)), (("world_model",), ("agentview",)), (("reflector",), ("agentview",)),
     (tuple(OTHERS), ("agentview", "wrist"))],
)  # fmt: skip
def test_another_part_runs_through_the_same_recipe(tiny, capsys, swapped, cameras):
    config = dataclasses.replace(tiny, cameras=cameras)
    run_all(config, dataclasses.replace(COMPACT, **{name: OTHERS[name] for name in swapped}))
    folder = RunFolder(config.run_dir)
    assert all(folder.done(stage.name) for stage in plan(config))
    told = capsys.readouterr()
    assert "missing in the report" not in told.out and "the report could not be written" not in told.err
    recorded = read_metadata(folder.rollouts("post_train_000"))
    assert set(recorded["models"]) == {"policy", "world_model", "reflector"}
    assert recorded["env"]["cameras"] == list(cameras)


def test_the_compact_parts_learn_through_two_cameras(tiny, capsys):
    config = dataclasses.replace(tiny, cameras=("agentview", "wrist"))
    run_all(config)
    assert "missing in the report" not in capsys.readouterr().out
    lines = RunFolder(config.run_dir).read_metrics("world_model")
    assert any("psnr_model_1_wrist" in line for line in lines)


def test_a_vision_language_model_is_fine_tuned_and_post_trained_by_the_same_recipe(tiny, capsys):
    config = dataclasses.replace(tiny, cameras=("agentview", "wrist"))
    run_all(config, dataclasses.replace(COMPACT, policy=VISION_LANGUAGE))
    folder = RunFolder(config.run_dir)
    assert all(folder.done(stage.name) for stage in plan(config))
    assert "missing in the report" not in capsys.readouterr().out
    before, after = (HFPolicy.from_pretrained(folder.checkpoint(name)).state_dict() for name in ("sft", "post_train"))
    changed = {name for name, tensor in after.items() if not torch.equal(tensor, before[name])}
    assert changed and all("lora_" in name or "head" in name or "proprio" in name for name in changed)
