"""Released checkpoints of OpenVLA-OFT: our module against what the reference implementation computed.

``openvla_oft/reference.json`` holds names and shapes of the reference's tensors (moojink/openvla-oft 213c5ff on its
fork of transformers 4.40.1 and timm 0.9.16, at tiny sizes), its config and statistics, and the actions that its
``predict_action`` gave, one observation at a time. Weights, images and states are a function of names: made here again.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import zlib
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tensordict import NonTensorStack, TensorDict

pytest.importorskip("transformers")

from tokenizers import Tokenizer, models, pre_tokenizers, processors

from worldenv_trl import keys
from worldenv_trl.policies import HFPolicy, load_openvla_oft

REFERENCE = json.loads((Path(__file__).parent / "openvla_oft" / "reference.json").read_text())
CAMERAS = ("agentview", "wrist")
SETTINGS = {"image_size": 28, "crop_area": 1.0, "dtype": "float32", "lora_rank": 0}


def noise(shape: tuple[int, ...], name: str) -> np.ndarray:
    """Numbers in [-1, 1) that depend on a name alone."""
    index = np.arange(1, int(np.prod(shape)) + 1, dtype=np.float64)
    x = np.sin(index * 12.9898 + zlib.crc32(name.encode()) % 9973) * 43758.5453
    return (2 * (x - np.floor(x)) - 1).reshape(shape)


def weight(name: str, shape: tuple[int, ...]) -> torch.Tensor:
    x = noise(shape, name)
    if len(shape) >= 2 and not name.endswith(("pos_embed", "token", "embed_tokens.weight", "latent")):
        x = x * np.sqrt(3 / np.prod(shape[1:]))
    elif name.endswith("bias"):
        x = 0.2 * x
    elif len(shape) == 1:
        x = 1 + 0.3 * x
    return torch.tensor(x, dtype=torch.float32)


def weights(part: str, prefix: str = "") -> dict[str, torch.Tensor]:
    layout = REFERENCE["layout"][part]
    return {prefix + name: weight(f"{part}.{name}", tuple(shape)) for name, shape in layout.items()}


@pytest.fixture(scope="module")
def released(tmp_path_factory) -> Path:
    """A folder as the checkpoints are released, their heads converted."""
    folder = tmp_path_factory.mktemp("oft")
    state = weights("model")
    names, index = sorted(state), {}
    for number, part in enumerate((names[: len(names) // 2], names[len(names) // 2 :]), 1):
        index |= dict.fromkeys(part, f"model-0000{number}-of-00002.safetensors")
        save_file({name: state[name] for name in part}, folder / index[part[0]])
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": index}))
    save_file(weights("action_head", "module."), folder / "action_head--7_checkpoint.safetensors")
    save_file(weights("proprio_projector", "module."), folder / "proprio_projector--7_checkpoint.safetensors")
    (folder / "config.json").write_text(json.dumps(REFERENCE["config"]))
    (folder / "dataset_statistics.json").write_text(json.dumps(REFERENCE["statistics"]))
    tokenizer = Tokenizer(models.WordLevel(REFERENCE["words"], unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.add_special_tokens(["<s>", "</s>"])
    tokenizer.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    tokenizer.save(str(folder / "tokenizer.json"))
    return folder


@pytest.fixture
def damaged(released, tmp_path) -> Path:
    """A copy by links, to be damaged."""
    for path in released.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


def observations() -> TensorDict:
    td = TensorDict(batch_size=[2])
    for camera in CAMERAS:
        levels = [np.floor((noise((3, 28, 28), f"image.{k}.{camera}") + 1) * 128).clip(0, 255) for k in range(2)]
        td[keys.image_key(camera)] = torch.tensor(np.stack(levels).astype(np.uint8))
    states = np.stack([noise((7,), f"state.{k}") for k in range(2)])
    states[:, 6] = (states[:, 6] + 1) / 2
    td[keys.STATE] = torch.tensor(states, dtype=torch.float32)
    td[keys.INSTRUCTION] = NonTensorStack(*REFERENCE["goals"])
    return td


def expected() -> torch.Tensor:
    """The reference's actions, [2, 8, 7]; its gripper, 0 closed and 1 open, as ours."""
    actions = torch.tensor(REFERENCE["actions"], dtype=torch.float32)
    actions[..., 6] = 1 - 2 * actions[..., 6]
    return actions


def test_actions_are_the_reference_implementations(released):
    policy = load_openvla_oft(released, **SETTINGS)
    actions = policy(observations())[keys.LOC]  # goals of two lengths in one batch: the shorter one is padded
    assert actions.std() > 0.3
    torch.testing.assert_close(actions, expected(), rtol=0, atol=1e-4)


def test_adapters_and_a_saved_copy_keep_them(released, tmp_path):
    policy = load_openvla_oft(released, **(SETTINGS | {"lora_rank": 4, "gradient_checkpointing": True}))
    policy.save_pretrained(tmp_path)
    actions = HFPolicy.from_pretrained(tmp_path)(observations())[keys.LOC]
    torch.testing.assert_close(actions, expected(), rtol=0, atol=1e-4)
    actions.sum().backward()


def test_fine_tuning_on_other_data_keeps_the_bounds_that_the_heads_were_trained_with(released):
    policy = load_openvla_oft(released, **SETTINGS)
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 7))
    torch.testing.assert_close(policy(observations())[keys.LOC], expected(), rtol=0, atol=1e-4)
    low, high = (torch.tensor(REFERENCE["statistics"]["libero_tiny_no_noops"]["action"][q]) for q in ("q01", "q99"))
    torch.testing.assert_close(policy.action_range[:6], ((high - low) / 2)[:6])
    assert policy.action_range[6] == 1  # the gripper goes from -1 to +1


def test_the_recipes_mirror_its_images_and_fit_its_bounds_to_liberos_files_alone(released, monkeypatch):
    import config
    import real_parts

    settings = dataclasses.replace(
        config.PRESETS["real-size"][1], real_size=config.RealSize(policy=released, dtype="float32")
    )
    for libero in (False, True):
        monkeypatch.setattr(real_parts, "from_libero", lambda _, value=libero: value)
        made = real_parts.make_policy(settings)
        assert made.config.mirror and made.config.fixed_statistics is not libero
        low = made.action_center.clone()
        made.fit_statistics(torch.rand(64, 7), torch.rand(64, 8, 7))
        assert torch.equal(low, made.action_center) is not libero


def test_in_bfloat16_they_are_close(released):
    policy = load_openvla_oft(released, **(SETTINGS | {"dtype": "bfloat16"}))
    assert policy.backbone.model.towers[0].pos_embed.dtype == torch.bfloat16
    assert (policy(observations())[keys.LOC] - expected()).abs().mean() < 0.05


def unlink(pattern: str):
    def damage(folder: Path) -> None:
        for path in folder.glob(pattern):
            path.unlink()

    return damage


def pickled(name: str):
    def damage(folder: Path) -> None:
        for path in folder.glob(f"{name}*.safetensors"):
            path.unlink()
        torch.save({}, folder / f"{name}--7_checkpoint.pt")

    return damage


def rewrite(name: str, change):
    def damage(folder: Path) -> None:
        fields = json.loads((folder / name).read_text())
        change(fields)
        (folder / name).unlink()
        (folder / name).write_text(json.dumps(fields))

    return damage


def two_statistics(fields: dict) -> None:
    fields["bridge_orig"] = fields["libero_tiny_no_noops"]


def short_proprio(fields: dict) -> None:
    fields["libero_tiny_no_noops"]["proprio"]["q99"].pop()


def truncate(folder: Path) -> None:
    path = folder / "model-00002-of-00002.safetensors"
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: len(data) // 2])


def swap_heads(folder: Path) -> None:
    path = folder / "action_head--7_checkpoint.safetensors"
    path.unlink()
    save_file({"module.model.conditioner.weight": torch.zeros(2)}, path)


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (unlink("config.json"), FileNotFoundError, "config.json is missing"),
        (unlink("model-00001*"), FileNotFoundError, "lacks model-00001-of-00002.safetensors, which model.safetensors"),
        (unlink("model*"), ValueError, "do not hold all of vision_backbone.featurizer"),
        (unlink("model-00002*"), FileNotFoundError, "lacks model-00002-of-00002.safetensors"),
        (unlink("*.safetensors*"), FileNotFoundError, "holds no weights"),
        (unlink("tokenizer.json"), FileNotFoundError, "tokenizer.json is missing: write it with"),
        (unlink("dataset_statistics.json"), FileNotFoundError, "dataset_statistics.json is missing"),
        (unlink("action_head*"), FileNotFoundError, r"action_head--\*_checkpoint.safetensors is missing"),
        (unlink("proprio_projector*"), FileNotFoundError, r"proprio_projector--\*_checkpoint.safetensors is missing"),
        (pickled("action_head"), ValueError, "action_head--7_checkpoint.pt is a pickle.*convert it once: python -c"),
        (swap_heads, ValueError, "holds no L1 regression head"),
        (truncate, ValueError, "model-00002-of-00002.safetensors is truncated or corrupt"),
        (
            rewrite("dataset_statistics.json", two_statistics),
            ValueError,
            "statistics must be named .* one of libero_tiny_no_noops, bridge_orig",
        ),
        (
            rewrite("dataset_statistics.json", short_proprio),
            ValueError,
            r"libero_tiny_no_noops.proprio.q99 must hold 8 numbers, got 7",
        ),
        (
            rewrite("config.json", lambda fields: fields.update(timm_model_ids=["vit"])),
            ValueError,
            r"describes an openvla with \['vit'\]: only the one with vit_large",
        ),
    ],
)
def test_what_is_wrong_with_a_folder_is_said_in_one_line(damaged, damage, error, message):
    damage(damaged)
    with pytest.raises(error, match=message) as caught:
        load_openvla_oft(damaged, **SETTINGS)
    assert "\n" not in str(caught.value)


def test_another_kind_of_checkpoint_is_named_with_what_reads_it(released, damaged):
    with pytest.raises(ValueError, match="holds an OpenVLA checkpoint: what reads it is load_openvla_oft"):
        HFPolicy.from_backbone(released)
    for fields, message in (
        ({"model_type": "llava"}, "a model of type 'llava': what reads it is HFPolicy.from_backbone"),
        ({"class": "HFPolicy", "config": {}}, "a HFPolicy of worldenv_trl: what reads it is HFPolicy.from_pretrained"),
        ({"type": "pi0", "input_features": {}}, "a LeRobot policy of type 'pi0': what reads it is load_lerobot"),
    ):
        (damaged / "config.json").unlink()
        (damaged / "config.json").write_text(json.dumps(fields))
        with pytest.raises(ValueError, match=message):
            load_openvla_oft(damaged, **SETTINGS)


def test_a_repository_of_the_hub_is_read_like_a_folder(released, tmp_path, monkeypatch):
    asked = []

    def snapshot_download(repo_id: str, **options) -> str:
        asked.append((repo_id, options["allow_patterns"]))
        return str(released)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    actions = load_openvla_oft("someone/arm", **SETTINGS)(observations())[keys.LOC]
    torch.testing.assert_close(actions, expected(), rtol=0, atol=1e-4)
    assert asked == [("someone/arm", ["*.json", "*.safetensors", "*.pt"])]


def test_an_unknown_statistics_key_is_answered_with_those_there_are(released):
    with pytest.raises(ValueError, match=r"no statistics 'libero_goal' in .*: pass statistics= one of libero_tiny"):
        load_openvla_oft(released, statistics="libero_goal", **SETTINGS)


def test_another_number_of_cameras_is_refused(released):
    with pytest.raises(ValueError, match=r"trained with 2 cameras, got 1 \(agentview\): name 2, or pass num_images=1"):
        load_openvla_oft(released, cameras=("agentview",), **SETTINGS)


def test_the_command_that_converts_a_pickle_works(damaged):
    (damaged / "action_head--7_checkpoint.safetensors").unlink()
    torch.save(weights("action_head", "module."), damaged / "action_head--7_checkpoint.pt")
    with pytest.raises(ValueError) as caught:
        load_openvla_oft(damaged, **SETTINGS)
    command = str(caught.value).split("convert it once: ")[1].replace("python -c", f"{sys.executable} -c", 1)
    subprocess.run(["bash", "-c", command], check=True)
    policy = load_openvla_oft(damaged, **SETTINGS)
    torch.testing.assert_close(policy(observations())[keys.LOC], expected(), rtol=0, atol=1e-4)


def test_on_the_meta_device_it_has_the_same_sizes_and_no_weights(released):
    outline, policy = (load_openvla_oft(released, device=device, **SETTINGS) for device in ("meta", "cpu"))
    assert {each.device.type for each in (*outline.parameters(), *outline.buffers())} == {"meta"}
    shapes = {name: (value.shape, value.dtype) for name, value in policy.state_dict().items()}
    assert {name: (value.shape, value.dtype) for name, value in outline.state_dict().items()} == shapes
