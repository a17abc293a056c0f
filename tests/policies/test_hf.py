"""HFPolicy: what learns, what is saved, statistics, precision, and folders of pretrained models."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest
import torch
from hf_models import FAMILIES, RESOLUTION, backbone, hf_policy, tokenizer
from observations import INSTRUCTIONS, observed
from torch import Tensor
from torchrl.objectives import BCLoss

from worldenv_trl import keys
from worldenv_trl.policies import HFConfig, HFPolicy, laplace_actor

transformers = pytest.importorskip("transformers")


def loss_of(policy: HFPolicy) -> Tensor:
    out = policy(observed(policy.cameras))
    return (out[keys.LOC] ** 2).sum() + (out[keys.LOG_SCALE] ** 2).sum()


def stir(policy: HFPolicy) -> None:
    """Adapters begin as zero products, whose inner factor gets no gradient."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if "lora_" in name:
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))


@pytest.mark.parametrize("family", FAMILIES)
def test_gradients_reach_adapters_and_heads_and_nothing_else(family):
    policy = hf_policy(family)
    groups = policy.post_training_parameters(2)
    stir(policy)
    loss_of(policy).backward()
    learning = {id(parameter) for group in groups.values() for parameter in group}
    # LLaVA reads the last but one layer of its eye: what lies behind it is computed for nothing.
    unread = "vision_tower.encoder.layers.1." if family == "llava" else "never"
    for name, parameter in policy.named_parameters():
        if id(parameter) not in learning:
            assert not parameter.requires_grad and parameter.grad is None, name
        elif unread not in name:
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    linear = [each for each in policy.backbone.modules() if hasattr(each, "lora_A")]
    assert {"adapters", "heads"} == set(groups) and len(groups["adapters"]) == 2 * len(linear) > 20
    assert all(parameter.dtype == torch.float32 for group in groups.values() for parameter in group)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_saved_policy_of_any_family_reloads_bit_for_bit(family, tmp_path):
    policy = hf_policy(family)
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 7))
    stir(policy)
    policy.save_pretrained(tmp_path)
    loaded = HFPolicy.from_pretrained(tmp_path)
    assert loaded.config == policy.config
    for key in (keys.LOC, keys.LOG_SCALE):
        assert torch.equal(loaded(observed())[key], policy(observed())[key])
    assert [p.requires_grad for p in loaded.parameters()] == [p.requires_grad for p in policy.parameters()]


@pytest.mark.parametrize("family", FAMILIES)
@torch.no_grad()
def test_rows_in_a_batch_are_answered_as_one_by_one(family):
    policy = hf_policy(family)
    td = observed()
    together = policy(td.clone())
    for key in (keys.LOC, keys.LOG_SCALE):
        alone = torch.cat([policy(td[i : i + 1].clone())[key] for i in range(6)])
        torch.testing.assert_close(together[key], alone, rtol=1e-4, atol=1e-5)
    assert together[keys.LOC].std(0).mean() > 1e-3  # rows differ


def test_without_a_stated_rank_new_adapters_change_nothing_and_others_are_refused():
    policy = hf_policy(lora_rank=0)
    before = policy(observed())[keys.LOC]
    policy.post_training_parameters(4)
    assert torch.equal(policy(observed())[keys.LOC], before)
    with pytest.raises(ValueError, match="has adapters of rank 4: it cannot get some of 2"):
        policy.post_training_parameters(2)
    full = hf_policy(lora_rank=0).post_training_parameters(0)
    assert set(full) == {"backbone", "heads"} and len(full["backbone"]) > 20


def test_statistics_map_the_quantiles_to_minus_one_and_one():
    policy = hf_policy()
    states = torch.linspace(-2, 4, 1001)[:, None].expand(-1, 7).contiguous()
    actions = torch.linspace(-0.5, 0.1, 1001)[:, None].expand(-1, 7).contiguous()
    actions[:, 4] = 0.25  # never moves
    policy.fit_statistics(states, actions)
    torch.testing.assert_close(policy.state_low, torch.full((7,), -1.94))  # 1 % of the way from -2 to 4
    torch.testing.assert_close(policy.state_high, torch.full((7,), 3.94))
    half = torch.full((7,), 0.294)
    half[4] = 0.005
    torch.testing.assert_close(policy.action_range, half)

    with torch.no_grad():  # the head's output alone decides now
        for parameter in policy.loc_head.linear_out.parameters():
            parameter.zero_()
        policy.loc_head.linear_out.bias.fill_(1.0)
    top = torch.full((7,), 0.094)
    top[4] = 0.255
    torch.testing.assert_close(policy(observed())[keys.LOC], top.expand(6, 8, 7))
    for bad in (torch.zeros(0, 7), torch.full((3, 7), float("nan"))):
        with pytest.raises(ValueError, match="actions must hold at least one row and only finite numbers"):
            policy.fit_statistics(states, bad)


def test_proprioception_beyond_the_bounds_is_clipped_to_them():
    policy = hf_policy()
    policy.fit_statistics(torch.rand(100, 7), torch.rand(100, 7))
    far, edge = (observed().set(keys.STATE, torch.full((6, 7), value)) for value in (50.0, 2.0))
    assert torch.equal(policy(far)[keys.LOC], policy(edge)[keys.LOC])


def cloning_loss(policy: HFPolicy) -> Tensor:
    """Functional: the parameters are in the module while it runs forward, and only then."""
    loss = BCLoss(laplace_actor(policy), loss_function="l1")
    loss.set_keys(action=keys.CHUNK)
    return loss(observed().set(keys.CHUNK, torch.full((6, 8, 7), 0.5)))["loss_bc"]


@pytest.mark.filterwarnings("ignore:The name target_actor_network_params")
@pytest.mark.parametrize("objective", [loss_of, cloning_loss])
@pytest.mark.parametrize("family", ["smolvlm", "prismatic"])
def test_checkpointing_gives_the_same_gradients(family, objective):
    kept, again = hf_policy(family), hf_policy(family, gradient_checkpointing=True)
    for policy in (kept, again):
        stir(policy)
        objective(policy).backward()
    for (name, first), (_, second) in zip(kept.named_parameters(), again.named_parameters(), strict=True):
        assert (first.grad is None) == (second.grad is None), name
        if first.grad is not None:
            torch.testing.assert_close(first.grad, second.grad, msg=name)


@pytest.mark.parametrize("family", ["llava", "paligemma", "smolvlm"])
def test_bfloat16_is_close_and_what_learns_stays_float32(family):
    full, half = hf_policy(family), hf_policy(family, dtype="bfloat16")
    assert half.backbone.language_model.get_input_embeddings().weight.dtype == torch.bfloat16
    adapted = [p for name, p in half.named_parameters() if "lora_" in name]
    assert adapted and all(parameter.dtype == torch.float32 for parameter in adapted)
    state = {name: t for name, t in full.state_dict().items()}
    half.load_state_dict(state)
    ours, theirs = (policy(observed())[keys.LOC] for policy in (half, full))
    assert ours.dtype == torch.float32
    torch.testing.assert_close(ours, theirs, rtol=0.1, atol=0.03)
    loss_of(half).backward()
    assert all(torch.isfinite(p.grad).all() for p in half.parameters() if p.grad is not None)


@pytest.fixture
def folder(tmp_path):
    """As transformers writes a pretrained model and its processor."""
    torch.manual_seed(1)
    model = transformers.AutoModelForImageTextToText.from_config(backbone("llava"))
    model.save_pretrained(tmp_path / "llava")
    tokenizer().save(str(tmp_path / "llava" / "tokenizer.json"))
    processor = {"image_mean": [0.1, 0.2, 0.3], "image_std": [1.0, 2.0, 3.0]}
    (tmp_path / "llava" / "preprocessor_config.json").write_text(json.dumps(processor))
    return tmp_path / "llava", model


def test_a_folder_of_a_pretrained_model_becomes_a_policy(folder):
    path, model = folder
    policy = HFPolicy.from_backbone(path, instructions=INSTRUCTIONS, image_size=64, lora_rank=0, head_dim=48)
    theirs = model.model.state_dict()
    assert policy.backbone.model.state_dict().keys() == theirs.keys()
    for name, tensor in policy.backbone.model.state_dict().items():
        assert torch.equal(tensor, theirs[name]), name
    assert policy.config.image_mean == (0.1, 0.2, 0.3) and policy.config.image_std == (1.0, 2.0, 3.0)
    assert policy.config.resolution == RESOLUTION
    assert policy(observed())[keys.LOC].shape == (6, 8, 7)


def remove(name: str):
    return lambda path: (path / name).unlink()


def pickle_weights(path) -> None:
    (path / "model.safetensors").unlink()
    torch.save({}, path / "pytorch_model.bin")


def other_family(path) -> None:
    (path / "config.json").write_text(json.dumps({"model_type": "bert"}))


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (
            remove("config.json"),
            FileNotFoundError,
            "config.json is missing, which a checkpoint folder must hold; there",
        ),
        (remove("tokenizer.json"), FileNotFoundError, "tokenizer.json is missing: write it with transformers'"),
        (remove("model.safetensors"), FileNotFoundError, "holds no weights: .*safetensors is missing"),
        (pickle_weights, ValueError, r"as pickles alone \(pytorch_model.bin\).*convert them once: python -c"),
        (other_family, ValueError, "model_type must be one of llava, paligemma, .*, got 'bert'"),
        (shutil.rmtree, FileNotFoundError, "there is: no such folder"),
    ],
)
def test_what_a_folder_lacks_is_said_before_anything_is_loaded(folder, damage, error, message):
    path, _ = folder
    damage(path)
    with pytest.raises(error, match=message):
        HFPolicy.from_backbone(path)


def test_a_saved_policy_without_its_tokenizer_is_refused(tmp_path):
    hf_policy().save_pretrained(tmp_path)
    (tmp_path / "tokenizer.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"tokenizer.json is missing"):
        HFPolicy.from_pretrained(tmp_path)


def test_a_tokenizer_without_the_familys_tokens_is_refused():
    from tokenizers import Tokenizer, models

    with pytest.raises(ValueError, match="has no token '<fake_token_around_image>', which smolvlm puts around images"):
        HFPolicy(hf_policy().config, Tokenizer(models.WordLevel({"<unk>": 0}, unk_token="<unk>")))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"attention": "causal"}, "'prefix' or 'full', got 'causal'"),
        ({"dtype": "float16"}, "'float32' or 'bfloat16', got 'float16'"),
        ({"prompt": "do it"}, "must hold {instruction}, got 'do it'"),
        ({"lora_rank": -1}, "must not be negative, got -1, 0"),
        ({"backbone": {"model_type": "gpt2"}}, "one of llava, paligemma, .*, got 'gpt2'"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(hf_policy().config, **settings)


def test_a_family_without_a_size_of_its_own_needs_one():
    with pytest.raises(ValueError, match="resolution must be given for qwen2_5_vl"):
        HFConfig(backbone=backbone("qwen2_5_vl").to_dict())
