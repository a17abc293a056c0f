"""The preset ``real-size`` on tiny local folders: its plan, and the whole run."""

from __future__ import annotations

import dataclasses

import pytest

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

import torch
from safetensors.torch import load_file
from tiny_folders import FRAME_SIZE, save_folders

import dry_run as dry
from config import PRESETS, RealSize
from real_parts import REAL_SIZE, parts_of
from rehearsal import rehearse
from run_folder import RunFolder
from stages import open_run, plan
from world_env import run_all
from worldenv_trl.policies import HFPolicy
from worldenv_trl.reflectors import VLMReflector
from worldenv_trl.world_models import DiffusionWorldModel


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return save_folders(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def small(tiny, folders):
    """The preset with the folders, and everything else as small as can be."""
    real = dataclasses.replace(PRESETS["real-size"][1], real_size=RealSize(**folders))
    kept = ("parts", "cameras")
    tiny = dataclasses.replace(tiny, **{name: getattr(real, name) for name in kept})
    settings = dataclasses.replace(real.real_size, frame_size=FRAME_SIZE, num_frames=4, score_every=4, dtype="float32")
    return dataclasses.replace(tiny, real_size=settings, post_train=dataclasses.replace(tiny.post_train, lora_rank=2))


def planned(config, capsys, *options: str) -> tuple[int, str]:
    chosen, _ = dry.split(["--dry-run", *options])
    count = dry.dry_run(config, chosen)
    return count, capsys.readouterr().out


def test_outlines_have_the_sizes_of_what_is_made_and_hold_no_memory(small):
    for name in ("policy", "world_model", "reflector"):
        part = getattr(REAL_SIZE, name)
        outline, made = part.outline(small), part.make(small)
        assert {each.device.type for each in outline.parameters()} == {"meta"}
        shapes = {key: (value.shape, value.dtype) for key, value in made.named_parameters()}
        assert {key: (value.shape, value.dtype) for key, value in outline.named_parameters()} == shapes


def test_what_is_made_has_the_weights_of_the_folder(small, folders):
    made = REAL_SIZE.policy.make(small)
    saved = load_file(folders["policy"] / "model.safetensors")
    name = "text_model.layers.0.mlp.down_proj"
    ours = made.backbone.model.get_submodule(name).base_layer.weight
    assert torch.equal(ours, saved[f"model.{name}.weight"])


def test_a_dry_run_prints_the_plan_and_touches_no_folder(small, capsys):
    count, printed = planned(small, capsys, "--gpus", "2", "--gpu", "A100", "--matmul-share", "0.5")
    assert count == 0 and not small.run_dir.exists()
    assert "error" not in printed and "published sizes" not in printed
    assert "2 x A100 (312.0 TFLOP/s and 80.0 GB each) at 50%" in printed
    for stage in plan(small):
        assert f"\n{stage.name} " in printed
    assert "policy: agentview, wrist uint8 [2, 3, 64, 64] -> chunk float32 [2, 8, 7]" in printed


def test_a_run_of_the_preset_completes_with_the_parts_of_the_folders(small, monkeypatch, capsys):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    run_all(small)
    folder = RunFolder(small.run_dir)
    assert all(folder.done(stage.name) for stage in plan(small))
    told = capsys.readouterr()
    assert "missing in the report" not in told.out and "the report could not be written" not in told.err
    run = open_run(small)
    assert isinstance(run.policy("post_train"), HFPolicy) and isinstance(run.reflector(), VLMReflector)
    assert isinstance(run.world_model(), DiffusionWorldModel)


@pytest.mark.parametrize(
    ("part", "file", "message"),
    [
        ("policy", "tokenizer.json", "tokenizer.json is missing"),
        ("policy", "model.safetensors", "holds no weights"),
        ("world_model", "unet/diffusion_pytorch_model.safetensors", "unet holds no weights"),
        ("reflector", "config.json", "config.json is missing"),
        ("reflector", "model.safetensors", "no *.safetensors in"),
    ],
)
def test_a_missing_file_is_one_line_of_a_dry_run_and_refuses_a_run(
    small, folders, tmp_path, capsys, part, file, message
):
    copy = tmp_path / "copy"
    for path in folders[part].rglob("*"):
        if path.is_file() and str(path.relative_to(folders[part])) != file:
            target = copy / path.relative_to(folders[part])
            target.parent.mkdir(parents=True, exist_ok=True)
            target.symlink_to(path)
    config = dataclasses.replace(small, real_size=dataclasses.replace(small.real_size, **{part: copy}))
    count, printed = planned(config, capsys)
    lines = [line for line in printed.splitlines() if line.startswith("error: ")]
    assert count == len(lines) == 1 and message in lines[0]
    with pytest.raises(SystemExit) as refused:
        open_run(config)
    assert message in str(refused.value) and not config.run_dir.exists()


def test_a_run_without_a_folder_is_refused_with_the_option_that_names_it(small):
    config = dataclasses.replace(small, real_size=dataclasses.replace(small.real_size, reflector=None))
    with pytest.raises(SystemExit, match=r"--real-size\.reflector names no folder"):
        open_run(config)
    assert not config.run_dir.exists()


def test_parts_that_were_made_for_another_run_are_a_line_each(small):
    made = {
        "policy": lambda config: REAL_SIZE.policy.outline(dataclasses.replace(config, chunk_length=4)),
        "world_model": lambda config: REAL_SIZE.world_model.outline(dataclasses.replace(config, image_size=48)),
    }
    found = rehearse(dataclasses.replace(small, cameras=("agentview",)), REAL_SIZE, made).problems
    assert len(found) == 2
    assert "policy: chunk lengths differ, its is 4, the run's 8: --chunk-length 4" in found[0]
    assert "world model: its images are of 48 px, the run's of 64: --image-size 48" in found[1]
    made = {
        "policy": lambda config: REAL_SIZE.policy.outline(dataclasses.replace(config, cameras=("agentview", "wrist")))
    }
    found = rehearse(dataclasses.replace(small, cameras=("agentview",)), REAL_SIZE, made).problems
    assert found == [
        "policy: it looks through agentview, wrist, the run's cameras are agentview: --cameras agentview wrist"
    ]


def test_the_parts_are_those_that_the_settings_name(small):
    assert parts_of(small) is REAL_SIZE
    with pytest.raises(ValueError, match="parts must be one of compact, real-size, got 'huge'"):
        parts_of(dataclasses.replace(small, parts="huge"))


def test_a_checkpoint_of_openvla_oft_needs_its_two_cameras(small, tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "openvla"}')
    real = dataclasses.replace(small.real_size, policy=tmp_path)
    with pytest.raises(ValueError, match=r"was trained with 2 cameras, got 1 \(agentview\): --cameras agentview wrist"):
        REAL_SIZE.policy.outline(dataclasses.replace(small, real_size=real, cameras=("agentview",)))
