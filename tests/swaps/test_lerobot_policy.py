"""A LeRobot checkpoint as the policy of the same recipe: fine-tuned, explored with, post-trained, evaluated, served."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

import torch
from policies.lerobot_folders import save_folder
from policies.observations import observed
from policies.policy_servers import ServerProcess

from config import RealSize
from parts import COMPACT
from real_parts import REAL_SIZE
from run_folder import RunFolder
from stages import plan
from world_env import run_all
from worldenv_trl import keys
from worldenv_trl.policies import ExternalPolicy, FlowPolicy, load_lerobot

CAMERAS = ("agentview", "wrist")


def lerobot_folder(folder: Path, kind: str) -> Path:
    """With a flow as long as the recipe's chunks."""
    save_folder(folder, kind)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"chunk_size": 10, "n_action_steps": 8}))
    return folder


@pytest.fixture
def small(tiny, tmp_path):
    real = RealSize(policy=lerobot_folder(tmp_path / "weights", "smolvla"), dtype="float32", mirror=True)
    post_train = dataclasses.replace(tiny.post_train, lora_rank=2)
    return dataclasses.replace(tiny, cameras=CAMERAS, real_size=real, post_train=post_train)


def test_it_is_fine_tuned_post_trained_and_evaluated_by_the_same_recipe(small, monkeypatch, capsys):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    run_all(small, dataclasses.replace(COMPACT, policy=REAL_SIZE.policy))
    folder = RunFolder(small.run_dir)
    assert all(folder.done(stage.name) for stage in plan(small))
    assert "missing in the report" not in capsys.readouterr().out
    before, after = (REAL_SIZE.policy.load(folder.checkpoint(name)) for name in ("sft", "post_train"))
    assert isinstance(after, FlowPolicy) and after.config.mirror and after.proprio == "commanded"
    released = load_lerobot(small.real_size.policy, dtype="float32", lora_rank=0)
    assert torch.equal(after.action_gain, released.action_gain)  # its flow ends in the checkpoint's units
    first, last = before.state_dict(), after.state_dict()
    changed = {name for name, tensor in last.items() if not torch.equal(tensor, first[name])}
    learned = ("lora_", "scale_head", "state_proj", "action_in_proj", "action_out_proj", "time_mlp")
    assert any("lora_" in name for name in changed) and any("action_out_proj" in name for name in changed)
    assert all(any(part in name for part in learned) for name in changed)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("kind", ["smolvla", "pi0", "pi05"])
def test_its_outline_has_the_sizes_of_what_is_made_and_runs_without_memory(small, tmp_path, kind, dtype):
    real = dataclasses.replace(small.real_size, policy=lerobot_folder(tmp_path / kind, kind), dtype=dtype)
    config = dataclasses.replace(small, real_size=real)
    outline, made = REAL_SIZE.policy.outline(config), REAL_SIZE.policy.make(config)
    shapes = {key: (value.shape, value.dtype) for key, value in made.named_parameters()}
    assert {key: (value.shape, value.dtype) for key, value in outline.named_parameters()} == shapes
    assert {each.device.type for each in outline.parameters()} == {"meta"}
    out = outline(observed(CAMERAS, texts=outline.instructions[0]).to("meta"))
    (out[keys.LOC].sum() + out[keys.LOG_SCALE].sum()).backward()
    assert out[keys.LOC].shape == (6, 8, 7)


def test_a_folder_that_does_not_suit_the_run_is_refused_before_any_work(small):
    config = dataclasses.replace(small, cameras=("agentview",))
    with pytest.raises(ValueError, match=r"looks through 2 cameras .* got 1 \(agentview\): name one for each"):
        REAL_SIZE.policy.make(config)


def test_its_folder_is_served_as_it_is(tmp_path):
    folder = lerobot_folder(tmp_path / "weights", "pi05")
    with ServerProcess(folder) as server:
        served, policy = ExternalPolicy.connect(server.address), load_lerobot(folder)
        assert served.cameras == CAMERAS and served.chunk_length == 8
        td = observed(CAMERAS, size=256)
        torch.testing.assert_close(served(td.copy())[keys.LOC], policy(td.copy())[keys.LOC])
