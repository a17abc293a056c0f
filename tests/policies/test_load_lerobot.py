"""LeRobot's SmolVLA, pi0 and pi0.5: our modules against what LeRobot's own modelling files computed."""

from __future__ import annotations

import json
from pathlib import Path

import huggingface_hub
import pytest
import torch
from lerobot_folders import CAMERAS, KINDS, REFERENCE, SIDE, expected, observations, save_folder, start, tokenizer
from safetensors.torch import load_file, save_file

from worldenv_trl import keys
from worldenv_trl.policies import FlowPolicy, HFPolicy, load_lerobot

SETTINGS = {"image_size": SIDE, "chunk_length": 6, "dtype": "float32", "lora_rank": 0}


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("lerobot")
    return {kind: save_folder(root / kind, kind) for kind in KINDS}


@pytest.fixture
def damaged(folders, tmp_path) -> Path:
    """A copy of SmolVLA's folder by links, to be damaged."""
    for path in folders["smolvla"].iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


def actions(policy: FlowPolicy) -> torch.Tensor:
    return policy(observations())[keys.LOC]


@pytest.mark.parametrize("buffers", [False, True], ids=["processors", "buffers"])
@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_the_reference_implementations(kind, buffers, folders, tmp_path):
    folder = save_folder(tmp_path, kind, buffers=True) if buffers else folders[kind]
    found = actions(start(load_lerobot(folder, **SETTINGS)))  # goals of two lengths in one batch
    assert found.std() > 0.3 and (found[0] - found[1]).abs().mean() > 0.05
    torch.testing.assert_close(found, expected(kind), rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_row_alone_gives_what_it_gives_in_a_batch(kind, folders):
    policy = start(load_lerobot(folders[kind], **SETTINGS))
    td = observations()
    for row in range(2):
        torch.testing.assert_close(policy(td[[row]])[keys.LOC], expected(kind)[[row]], rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_adapters_checkpoints_of_activations_and_a_saved_copy_keep_them(kind, folders, tmp_path):
    policy = start(load_lerobot(folders[kind], **(SETTINGS | {"lora_rank": 2, "gradient_checkpointing": True})))
    policy.save_pretrained(tmp_path)
    saved = FlowPolicy.from_pretrained(tmp_path).train()
    groups = saved.post_training_parameters(rank=2)
    found = actions(saved)
    torch.testing.assert_close(found, expected(kind), rtol=0, atol=1e-4)
    found.square().sum().backward()
    used = [each for group in groups.values() for each in group if each.grad is not None and each.grad.any()]
    lost = {id(each) for group in groups.values() for each in group} - {id(each) for each in used}
    names = [name for name, each in saved.named_parameters() if id(each) in lost]
    assert all("lora_A" in name or "scale_head" in name for name in names)  # behind a lora_B that is still zero


def test_gradients_through_the_integration_are_those_of_finite_differences(folders):
    policy = start(load_lerobot(folders["pi05"], **SETTINGS))
    weight = policy.network.action_in_proj.weight
    actions(policy).sin().sum().backward()
    direction = weight.grad / weight.grad.norm()
    with torch.no_grad():
        weight += 1e-3 * direction
        above = actions(policy).sin().sum()
        weight -= 2e-3 * direction
        below = actions(policy).sin().sum()
    assert weight.grad.norm() > 0.1
    assert weight.grad.norm().item() == pytest.approx(((above - below) / 2e-3).item(), rel=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_in_bfloat16_they_are_close(kind, folders):
    policy = start(load_lerobot(folders[kind], **(SETTINGS | {"dtype": "bfloat16"})))
    assert policy.network.expert.layers[0].mlp.up_proj.weight.dtype == torch.bfloat16
    assert policy.network.action_out_proj.weight.dtype == torch.float32
    assert (actions(policy) - expected(kind)).abs().mean() < 0.1


def test_a_chunk_is_the_first_of_the_actions_that_the_flow_makes(folders):
    policy = start(load_lerobot(folders["pi0"], **(SETTINGS | {"chunk_length": 3})))
    torch.testing.assert_close(actions(policy), expected("pi0")[:, :3], rtol=0, atol=1e-4)
    unsaid = {name: value for name, value in SETTINGS.items() if name != "chunk_length"}
    assert load_lerobot(folders["pi0"], **unsaid).chunk_length == 4  # its n_action_steps


def test_the_noise_that_a_flow_begins_with_is_its_seeds_alone(folders):
    first, same, other = (load_lerobot(folders["pi0"], noise_seed=seed, **SETTINGS) for seed in (0, 0, 1))
    assert torch.equal(actions(first), actions(same))
    assert (actions(first) - actions(other)).abs().mean() > 0.01


def test_mirrored_images_are_seen_as_their_mirror_images(folders):
    policy = start(load_lerobot(folders["smolvla"], mirror=True, **SETTINGS))
    td = observations()
    for camera in CAMERAS:
        td[keys.image_key(camera)] = td[keys.image_key(camera)].flip(-1)
    torch.testing.assert_close(policy(td)[keys.LOC], expected("smolvla"), rtol=0, atol=1e-4)


def test_it_does_without_a_camera_that_it_was_trained_with(folders):
    policy = load_lerobot(
        folders["pi0"], cameras=("agentview",), image_features=["observation.images.image"], **SETTINGS
    )
    td = observations()
    assert torch.equal(policy(td)[keys.LOC], policy(td.exclude(keys.image_key("wrist")))[keys.LOC])


def test_statistics_of_the_checkpoint_are_kept_unless_they_are_to_be_fitted(folders):
    policy = start(load_lerobot(folders["pi0"], **SETTINGS))
    data = torch.randn(200, 7), torch.randn(200, 7)
    policy.fit_statistics(*data)
    torch.testing.assert_close(actions(policy), expected("pi0"), rtol=0, atol=1e-4)
    known = REFERENCE["pi0"]["statistics"]["action"]
    half = (torch.tensor(known["max"]) - torch.tensor(known["min"])) / 2
    torch.testing.assert_close(policy.action_range, half.clamp(max=1.0))
    policy = load_lerobot(folders["pi0"], fixed_statistics=False, **SETTINGS)
    policy.fit_statistics(*data)
    torch.testing.assert_close(policy.action_center, data[1].mean(0))
    torch.testing.assert_close(policy.action_gain, data[1].std(0, correction=0))
    policy = load_lerobot(folders["pi05"], fixed_statistics=False, **SETTINGS)
    policy.fit_statistics(*data)
    low, high = data[1].quantile(0.01, 0), data[1].quantile(0.99, 0)
    torch.testing.assert_close(policy.action_center - policy.action_gain, low)
    torch.testing.assert_close(policy.action_center + policy.action_gain, high)


def test_older_names_of_weights_are_understood(folders, tmp_path):
    save_folder(tmp_path, "pi0")
    state = load_file(tmp_path / "model.safetensors")
    older = {}
    for name, tensor in state.items():
        name = name.removeprefix("model.").replace("paligemma.model.language_model.", "paligemma.language_model.model.")
        name = name.replace("paligemma.model.", "paligemma.").replace("vision_tower.vision_model.", "vision_tower.")
        older[name] = tensor.clone()
    assert not set(older) & set(state)
    save_file(older, tmp_path / "model.safetensors")
    found = actions(start(load_lerobot(tmp_path, **SETTINGS)))
    torch.testing.assert_close(found, expected("pi0"), rtol=0, atol=1e-4)


def test_a_tokenizer_is_read_where_newer_folders_keep_it(folders, tmp_path):
    save_folder(tmp_path, "pi05")
    (tmp_path / "tokenizer").mkdir()
    (tmp_path / "tokenizer.json").rename(tmp_path / "tokenizer" / "tokenizer.json")
    found = actions(start(load_lerobot(tmp_path, **SETTINGS)))
    torch.testing.assert_close(found, expected("pi05"), rtol=0, atol=1e-4)


def test_repositories_of_the_hub_are_read_like_folders(folders, tmp_path, monkeypatch):
    asked = []

    def snapshot_download(repo_id: str, **options) -> str:
        asked.append((repo_id, options["allow_patterns"]))
        return str(folders["smolvla"] / ("vlm" if "vlm" in repo_id else ""))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    found = actions(start(load_lerobot("someone/arm", backbone="someone/vlm", **SETTINGS)))
    torch.testing.assert_close(found, expected("smolvla"), rtol=0, atol=1e-4)
    assert [name for name, _ in asked] == ["someone/arm", "someone/vlm"]
    assert asked[1][1] == ["config.json", "tokenizer.json"]  # its weights are in the policy's


@pytest.mark.parametrize("kind", KINDS)
def test_on_the_meta_device_it_has_the_same_sizes_and_no_weights(kind, folders):
    outline, policy = (load_lerobot(folders[kind], device=device, **SETTINGS) for device in ("meta", "cpu"))
    assert {each.device.type for each in (*outline.parameters(), *outline.buffers())} == {"meta"}
    shapes = {name: (value.shape, value.dtype) for name, value in policy.state_dict().items()}
    assert {name: (value.shape, value.dtype) for name, value in outline.state_dict().items()} == shapes
    assert outline(observations().to("meta"))[keys.LOC].shape == (2, 6, 7)


def unlink(*names: str):
    def damage(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return damage


def rewrite(name: str, **changes):
    def damage(folder: Path) -> None:
        fields = json.loads((folder / name).read_text())
        (folder / name).unlink()
        (folder / name).write_text(json.dumps(fields | changes))

    return damage


def without(name: str, field: str):
    def damage(folder: Path) -> None:
        fields = json.loads((folder / name).read_text())
        (folder / name).unlink()
        (folder / name).write_text(json.dumps({each: value for each, value in fields.items() if each != field}))

    return damage


def reweigh(change):
    def damage(folder: Path) -> None:
        state = load_file(folder / "model.safetensors")
        change(state)
        (folder / "model.safetensors").unlink()
        save_file(state, folder / "model.safetensors")

    return damage


def pickled(folder: Path) -> None:
    for path in folder.glob("*.safetensors"):
        path.unlink()
    torch.save({}, folder / "pytorch_model.bin")


def truncate(folder: Path) -> None:
    data = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").unlink()
    (folder / "model.safetensors").write_bytes(data[: len(data) // 2])


def other_backbone(folder: Path) -> None:
    (folder / "other").mkdir()
    (folder / "other" / "config.json").write_text('{"model_type": "llava"}')
    tokenizer(False).save(str(folder / "other" / "tokenizer.json"))
    rewrite("config.json", vlm_model_name=str(folder / "other"))(folder)


CONFIG = REFERENCE["smolvla"]["config"]
LAYER = "model.vlm_with_expert.lm_expert.layers.1.mlp.up_proj.weight"


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (unlink("config.json"), FileNotFoundError, "config.json is missing"),
        (unlink("model.safetensors"), FileNotFoundError, r"holds no weights: model\*.safetensors is missing"),
        (pickled, ValueError, "holds its weights as pickles alone.*convert them once: python -c"),
        (truncate, ValueError, "model.safetensors is truncated or corrupt"),
        (
            rewrite("config.json", type="act"),
            ValueError,
            "of type 'act', known are smolvla, pi0, pi05, pi0_fast: any other runs",
        ),
        (rewrite("config.json", model_type="openvla"), ValueError, "an OpenVLA checkpoint: what reads it is load_open"),
        (rewrite("config.json", input_features=3), ValueError, "input_features must hold a type and a shape"),
        (rewrite("config.json", input_features={}), ValueError, "has no feature observation.state: there are none"),
        (
            rewrite("config.json", input_features={"observation.state": {"type": "STATE", "shape": [8]}}),
            ValueError,
            "cameras must name at least one camera",
        ),
        (rewrite("config.json", output_features={}), ValueError, "has no feature action"),
        (rewrite("config.json", adapt_to_pi_aloha=True), ValueError, "trained with adapt_to_pi_aloha"),
        (without("config.json", "chunk_size"), ValueError, "config.json lacks chunk_size: fetch it again"),
        (rewrite("config.json", n_obs_steps=2), ValueError, "looks at 2 observations: only 1 is known"),
        (
            rewrite("config.json", resize_imgs_with_padding=[28, 14]),
            ValueError,
            r"resizes images to \[28, 14\]: only",
        ),
        (rewrite("config.json", add_image_special_tokens=True), ValueError, "tokens around images of cameras that"),
        (rewrite("config.json", vlm_model_name="none"), FileNotFoundError, "nor could none be read.*backbone= a fold"),
        (rewrite("config.json", num_vlm_layers=2), ValueError, "3 layers of an expert cannot stand beside 2"),
        (other_backbone, ValueError, "holds a 'llava', smolvla stands on a smolvlm"),
        (
            rewrite("config.json", output_features={"action": {"type": "ACTION", "shape": [6]}}),
            ValueError,
            r"trained for states \[8\] and actions \[6\], this arm has \[7\] .*fixed_statistics=False begins with",
        ),
        (
            rewrite("policy_preprocessor.json", steps=[{"registry_name": "normalizer_processor", "state_file": "a"}]),
            FileNotFoundError,
            "a is missing, whose statistics policy_preprocessor.json names",
        ),
        (
            unlink("policy_preprocessor.json", "policy_postprocessor.json"),
            ValueError,
            r"normalises observation.state by MEAN_STD and holds no mean of it \(there are: none\): take the folder",
        ),
        (reweigh(lambda state: state.pop(LAYER)), ValueError, r"1 tensors are missing \(expert.layers.1.mlp.up_proj"),
        (reweigh(lambda state: state.update(more=torch.ones(2))), ValueError, r"1 are unknown \(more\)"),
        (
            reweigh(lambda state: state.update({LAYER: torch.ones(2, 2)})),
            ValueError,
            r"expert.layers.1.mlp.up_proj.weight is \[2, 2\], not \[256, 36\]",
        ),
    ],
)
def test_what_is_wrong_with_a_folder_is_said_in_one_line(damaged, damage, error, message):
    damage(damaged)
    with pytest.raises(error, match=message) as caught:
        load_lerobot(damaged, **SETTINGS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "said", "message"),
    [
        ("pi0", "pi05", r"\d+ tensors are missing \(expert.layers.0.input_layernorm.dense.bias, .* are unknown"),
        ("smolvla", "pi0", "holds no weights of a PaliGemma: this is no pi0 of LeRobot"),
    ],
)
def test_weights_of_another_kind_than_the_config_says_are_refused(folders, tmp_path, kind, said, message):
    for path in folders[kind].iterdir():
        (tmp_path / path.name).symlink_to(path)
    rewrite("config.json", type=said)(tmp_path)
    if not (tmp_path / "tokenizer.json").exists():
        tokenizer(True).save(str(tmp_path / "tokenizer.json"))
    with pytest.raises(ValueError, match=message) as caught:
        load_lerobot(tmp_path, **SETTINGS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cameras": ("agentview",)}, r"looks through 2 cameras \(.*image, .*image2\), got 1 \(agentview\): name one"),
        ({"image_features": ["top"]}, "has no image feature 'top': image_features= of observation.images.image, obs"),
        ({"chunk_length": 7}, "at most 6, the actions that this flow makes at once, got 7"),
        ({"dtype": "int8"}, "dtype must be one of float32, bfloat16, got 'int8'"),
        ({"lora_rank": -1}, "must not be negative"),
    ],
)
def test_what_it_cannot_be_is_named(folders, settings, message):
    with pytest.raises(ValueError, match=message):
        load_lerobot(folders["pi0"], **(SETTINGS | settings))


def test_other_readers_name_this_one(folders):
    with pytest.raises(ValueError, match="holds a LeRobot policy of type 'pi05': what reads it is load_lerobot"):
        HFPolicy.from_backbone(folders["pi05"])
