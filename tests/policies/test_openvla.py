"""Released checkpoints of OpenVLA: our module against what the reference implementation computed.

``openvla/reference.json`` holds what openvla/openvla c8f03f4 gave (transformers 4.40.1, timm 0.9.16) at the sizes, with
the config, statistics, images and weights of ``openvla_oft/reference.json``, but for the rows of its language head that
stand for actions: these are four times as large, so that it says actions of itself. ``tokens`` and ``actions`` are
those of its ``predict_action``; ``logits`` every 32nd of the action tokens' in its forward without a cache, and
``log_probs`` of the tokens under the softmax over action tokens.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from test_openvla_oft import REFERENCE as SIZES
from test_openvla_oft import observations, unlink, weights

pytest.importorskip("transformers")

from tokenizers import Tokenizer, models, pre_tokenizers, processors

from worldenv_trl import keys
from worldenv_trl.policies import AutoregressiveActor, HFPolicy, HFTokenPolicy, load_openvla, load_openvla_oft

REFERENCE = json.loads((Path(__file__).parent / "openvla" / "reference.json").read_text())
SETTINGS = {"image_size": 28, "crop_area": 1.0, "dtype": "float32", "lora_rank": 0}
FIRST, END = 31744, 32000
STATISTICS = SIZES["statistics"]["libero_tiny_no_noops"]["action"]


def write_tokenizer(folder: Path, first: int = FIRST) -> None:
    known = SIZES["words"] | {f"<{number}>": number for number in range(first, END)}
    tokenizer = Tokenizer(models.WordLevel(known, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.add_special_tokens(["<s>", "</s>"])
    tokenizer.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    tokenizer.save(str(folder / "tokenizer.json"))


@pytest.fixture(scope="module")
def released(tmp_path_factory) -> Path:
    """A folder as the checkpoints are released: statistics in the config."""
    folder = tmp_path_factory.mktemp("openvla")
    state = weights("model")
    state["language_model.lm_head.weight"][FIRST:END] *= 4
    save_file(state, folder / "model.safetensors")
    config = SIZES["config"] | {"norm_stats": SIZES["statistics"]}
    (folder / "config.json").write_text(json.dumps(config))
    write_tokenizer(folder)
    return folder


@pytest.fixture
def damaged(released, tmp_path) -> Path:
    """A copy by links, to be damaged."""
    for path in released.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


def expected() -> torch.Tensor:
    """The reference's actions, [2, 1, 7]; its gripper, 0 closed and 1 open, as ours."""
    actions = torch.tensor(REFERENCE["actions"], dtype=torch.float64)[:, None]
    actions[..., 6] = 1 - 2 * actions[..., 6]
    return actions.float()


def test_tokens_and_actions_are_the_reference_implementations(released):
    policy = load_openvla(released, **SETTINGS)
    td = AutoregressiveActor(policy, event_dims=0)(observations())  # goals of two lengths in one batch
    assert (td[keys.TOKENS][:, 0] + FIRST).tolist() == REFERENCE["tokens"]
    assert torch.equal(td[keys.CHUNK], expected())
    theirs = torch.tensor(REFERENCE["log_probs"])[:, None]
    torch.testing.assert_close(td[keys.LOG_PROBS], theirs, rtol=0, atol=1e-4)


def test_logits_are_the_reference_implementations(released):
    policy = load_openvla(released, **SETTINGS)
    _, observed = policy.observed(observations())
    tokens = torch.tensor(REFERENCE["tokens"])[:, None] - FIRST
    logits = policy.logits(*observed, tokens)[:, 0, :, ::32]  # [2, 7, 8]
    torch.testing.assert_close(logits, torch.tensor(REFERENCE["logits"]), rtol=0, atol=1e-4)


def test_adapters_and_a_saved_copy_keep_them(released, tmp_path):
    policy = load_openvla(released, **(SETTINGS | {"lora_rank": 4, "gradient_checkpointing": True}))
    policy.save_pretrained(tmp_path)
    loaded = HFTokenPolicy.from_pretrained(tmp_path)
    td = AutoregressiveActor(loaded)(observations())
    assert torch.equal(td[keys.CHUNK], expected())
    AutoregressiveActor(loaded).get_dist(td).log_prob(td[keys.TOKENS]).sum().backward()
    assert loaded.action_head.weight.grad.abs().sum() > 0


def reference_decode(ids: np.ndarray) -> np.ndarray:
    """Detokenisation as the reference's formulae say, in NumPy."""
    edges = np.linspace(-1, 1, 256)
    centres = (edges[:-1] + edges[1:]) / 2
    unit = centres[np.clip(END - ids - 1, 0, 254)]
    low, high = np.array(STATISTICS["q01"]), np.array(STATISTICS["q99"])
    return np.where(STATISTICS["mask"], 0.5 * (unit + 1) * (high - low) + low, unit)


def test_every_token_stands_for_the_number_that_the_reference_says(released):
    tokenizer = load_openvla(released, **SETTINGS).action_tokenizer
    ids = np.arange(FIRST, END)[:, None].repeat(7, 1)
    theirs = reference_decode(ids)
    theirs[:, 6] = 1 - 2 * theirs[:, 6]
    ours = tokenizer.decode(torch.from_numpy(ids) - FIRST)
    assert torch.equal(ours, torch.from_numpy(theirs).float())
    again = tokenizer.encode(ours.double())
    assert torch.equal(again, (torch.from_numpy(ids) - FIRST).clamp(min=1))  # the two highest are one bin


def test_actions_become_the_tokens_that_the_references_training_gives_them(released):
    tokenizer = load_openvla(released, **SETTINGS).action_tokenizer
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (500, 7))
    low, high = np.array(STATISTICS["q01"]), np.array(STATISTICS["q99"])
    theirs = np.where(STATISTICS["mask"], 2 * (actions - low) / (high - low + 1e-8) - 1, (1 - actions) / 2)
    ids = END - np.digitize(np.clip(theirs, -1, 1), np.linspace(-1, 1, 256))
    assert (tokenizer.encode(torch.from_numpy(actions)).numpy() + FIRST == ids).mean() > 0.999
    assert np.unique(ids).size > 200


def test_fine_tuning_on_other_data_keeps_the_bins_that_it_was_trained_with(released):
    policy = load_openvla(released, **SETTINGS)
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 7))
    assert torch.equal(AutoregressiveActor(policy)(observations())[keys.CHUNK], expected())
    low, high = (torch.tensor(STATISTICS[name]) for name in ("q01", "q99"))
    torch.testing.assert_close(policy.action_range[:6], ((high - low) / 2)[:6])
    assert policy.action_range[6] == 1  # the gripper goes from -1 to +1


def test_longer_chunks_go_on_with_the_same_tokens(released):
    policy = load_openvla(released, chunk_length=2, **SETTINGS)
    tokens = AutoregressiveActor(policy)(observations())[keys.TOKENS]
    assert tokens.shape == (2, 2, 7) and (tokens[:, 0] + FIRST).tolist() == REFERENCE["tokens"]


def test_statistics_of_fine_tuning_take_the_place_of_those_in_the_config(damaged):
    other = {"mine": {"action": STATISTICS | {"q99": [2.0] * 7}}}
    (damaged / "dataset_statistics.json").write_text(json.dumps(other))
    assert load_openvla(damaged, **SETTINGS).action_tokenizer.high[0] == 2.0


def test_on_the_meta_device_it_has_the_same_sizes_and_no_weights(released):
    outline, policy = (load_openvla(released, device=device, **SETTINGS) for device in ("meta", "cpu"))
    assert {each.device.type for each in (*outline.parameters(), *outline.buffers())} == {"meta"}
    shapes = {name: (value.shape, value.dtype) for name, value in policy.state_dict().items()}
    assert {name: (value.shape, value.dtype) for name, value in outline.state_dict().items()} == shapes


def rewrite(**changes):
    def damage(folder: Path) -> None:
        fields = json.loads((folder / "config.json").read_text()) | changes
        (folder / "config.json").unlink()
        (folder / "config.json").write_text(json.dumps(fields))

    return damage


def without_head(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    state = weights("model")
    del state["language_model.lm_head.weight"]
    save_file(state, folder / "model.safetensors")


def short_tokenizer(folder: Path) -> None:
    (folder / "tokenizer.json").unlink()
    write_tokenizer(folder, first=31900)


def with_heads(folder: Path) -> None:
    save_file(weights("action_head"), folder / "action_head--7_checkpoint.safetensors")


TWO = {"norm_stats": {"bridge_orig": {"action": STATISTICS}, "libero": {"action": STATISTICS}}}
SHORT = {"norm_stats": {"mine": {"action": STATISTICS | {"q01": [0.0] * 6}}}}


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (unlink("config.json"), FileNotFoundError, "config.json is missing"),
        (unlink("*.safetensors"), FileNotFoundError, "holds no weights"),
        (unlink("tokenizer.json"), FileNotFoundError, "tokenizer.json is missing: write it with"),
        (rewrite(norm_stats=None), FileNotFoundError, "dataset_statistics.json is missing"),
        (
            rewrite(**TWO),
            ValueError,
            "statistics must be named in .*config.json: pass statistics= one of bridge_orig, l",
        ),
        (rewrite(**SHORT), ValueError, r"config.json: mine.action.q01 must hold 7 numbers, got 6"),
        (
            rewrite(timm_model_ids=["vit"]),
            ValueError,
            r"describes an openvla with \['vit'\]: only the one with vit_large",
        ),
        (rewrite(model_type="llava"), ValueError, "a model of type 'llava': what reads it is HFPolicy.from_backbone"),
        (without_head, ValueError, "lacks language_model.lm_head.weight, which reads the action tokens out"),
        (short_tokenizer, ValueError, "no token of the ids 31744 to 31899, and 31744 to 31999 stand for actions"),
        (with_heads, ValueError, "holds OpenVLA-OFT's heads and does not act by tokens: load_openvla_oft reads it"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said_in_one_line(damaged, damage, error, message):
    damage(damaged)
    with pytest.raises(error, match=message) as caught:
        load_openvla(damaged, **SETTINGS)
    assert "\n" not in str(caught.value)


def test_settings_that_do_not_suit_the_checkpoint_are_named(released):
    with pytest.raises(ValueError, match=r"no statistics 'goal' in .*: pass statistics= one of libero_tiny_no_noops"):
        load_openvla(released, statistics="goal", **SETTINGS)
    with pytest.raises(ValueError, match=r"trained with 1 camera, got 2 \(agentview, wrist\): name 1, or pass num_ima"):
        load_openvla(released, cameras=("agentview", "wrist"), **SETTINGS)


def test_the_other_readers_name_this_one(released, damaged):
    with pytest.raises(
        ValueError, match="an OpenVLA checkpoint: what reads it is load_openvla_oft, or load_openvla wh"
    ):
        HFPolicy.from_backbone(released)
    (damaged / "dataset_statistics.json").write_text(json.dumps(SIZES["statistics"]))
    with pytest.raises(FileNotFoundError, match="a checkpoint without it acts by tokens: load_openvla"):
        load_openvla_oft(damaged, **SETTINGS)
