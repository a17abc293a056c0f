"""A policy that acts by tokens through the same recipe: cloned by cross-entropy, post-trained by LOOP on its tokens."""

from __future__ import annotations

import dataclasses

import pytest

pytest.importorskip("transformers")

import torch
from policies import hf_models
from policies.hf_token_policies import VOCABULARY, action_words
from safetensors.torch import load_file
from transformers import AutoModelForImageTextToText

from config import RealSize
from parts import COMPACT, Part, instructions
from real_parts import REAL_SIZE
from rehearsal import rehearse
from run_folder import RunFolder
from serve import load_policy
from stages import plan
from world_env import run_all
from worldenv_trl import keys
from worldenv_trl.policies import HFTokenConfig, HFTokenPolicy
from worldenv_trl.record import read_rollouts


def token_policy(config) -> HFTokenPolicy:
    settings = HFTokenConfig(
        backbone=hf_models.backbone("smolvlm").to_dict(),
        instructions=instructions(config),
        image_size=config.image_size,
        chunk_length=config.chunk_length,
        cameras=config.cameras,
        num_bins=16,
        lora_rank=config.post_train.lora_rank,
        gradient_checkpointing=True,
    )
    return HFTokenPolicy(settings, action_words(size=VOCABULARY))


PARTS = dataclasses.replace(COMPACT, policy=Part(token_policy, HFTokenPolicy.from_pretrained))


@pytest.fixture(autouse=True)
def forgiving_expert(monkeypatch):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert


@pytest.mark.parametrize("level", ["token", "chunk"])
def test_a_token_policy_is_cloned_post_trained_and_evaluated(tiny, capsys, level):
    learning = dataclasses.replace(tiny.post_train, ratio_level=level, lora_rank=2)
    config = dataclasses.replace(
        tiny, post_train=learning, explore=dataclasses.replace(tiny.explore, scale_factors=(0.0, 1.0))
    )
    run_all(config, PARTS)
    folder = RunFolder(config.run_dir)
    assert all(folder.done(stage.name) for stage in plan(config))
    told = capsys.readouterr()
    assert "missing in the report" not in told.out and "the report could not be written" not in told.err
    assert any("cross_entropy" in line for line in folder.read_metrics("sft"))
    before, after = (HFTokenPolicy.from_pretrained(folder.checkpoint(name)) for name in ("sft", "post_train"))
    changed = {name for name, value in after.state_dict().items() if not torch.equal(value, before.state_dict()[name])}
    assert changed and all("lora_" in name or "action_head" in name for name in changed)

    wave = read_rollouts(folder.rollouts("post_train_000"))[0]  # of the weights that learned from it: the first ones
    wave = wave[wave[keys.MASK]]
    tokens, chunk = wave[keys.TOKENS], wave[keys.CHUNK]
    assert tokens.dtype == torch.int64 and tokens.shape == chunk.shape
    assert torch.equal(chunk, before.action_tokenizer.decode(tokens))
    shape = tokens.shape if level == "token" else tokens.shape[:-1]
    assert wave[keys.LOG_PROBS].shape == wave[keys.RATIO].shape == shape
    _, observed = before.observed(wave)
    with torch.no_grad():
        scored = before.logits(*observed, tokens).log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
    scored = scored if level == "token" else scored.sum(-1)
    torch.testing.assert_close(wave[keys.LOG_PROBS], scored, rtol=1e-4, atol=1e-4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A SmolVLM as ``save_pretrained`` writes it, with room for 256 action tokens."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("smolvlm")
    network = hf_models.backbone("smolvlm")
    network.text_config.vocab_size = 320
    AutoModelForImageTextToText.from_config(network).save_pretrained(path)
    action_words(size=320).save(str(path / "tokenizer.json"))
    return path


def real(tiny, path, **settings):
    """The compact preset's sizes with the policy of a folder."""
    real_size = RealSize(policy=path, action_head="tokens", dtype="float32")
    learning = dataclasses.replace(tiny.post_train, ratio_level="token", lora_rank=2)
    return dataclasses.replace(
        tiny, **({"parts": "real-size", "real_size": real_size, "post_train": learning} | settings)
    )


def test_the_setting_makes_a_token_policy_of_a_folder(tiny, folder, tmp_path):
    config = real(tiny, folder)
    made, outline = REAL_SIZE.policy.make(config), REAL_SIZE.policy.outline(config)
    assert isinstance(made, HFTokenPolicy) and made.chunk_length == config.chunk_length
    saved = load_file(folder / "model.safetensors")
    assert torch.equal(made.action_head.weight, saved["lm_head.weight"][64:320])
    assert {each.device.type for each in outline.parameters()} == {"meta"}
    shapes = {name: (value.shape, value.dtype) for name, value in made.named_parameters()}
    assert {name: (value.shape, value.dtype) for name, value in outline.named_parameters()} == shapes
    made.save_pretrained(tmp_path / "saved")
    for loaded in (
        REAL_SIZE.policy.load(tmp_path / "saved"),
        load_policy(str(tmp_path / "saved"), torch.device("cpu")),
    ):
        assert isinstance(loaded, HFTokenPolicy) and torch.equal(loaded.action_head.weight, made.action_head.weight)


def test_a_decision_of_tokens_is_planned(tiny, folder):
    config = real(tiny, folder)
    found = rehearse(config, dataclasses.replace(COMPACT, policy=REAL_SIZE.policy))
    assert not found.problems and "policy: agentview uint8 [2, 3, 64, 64] -> chunk float32 [2, 8, 7]" in found.shapes
    # One by one, tokens read the weights again and again; one pass over them does the same work.
    assert found.calls["decide"].read_bytes > 20 * found.calls["score"].read_bytes
    assert found.calls["decide"].flops == pytest.approx(found.calls["score"].flops, rel=0.2)
    assert found.calls["sft"].flops > 2 * found.calls["score"].flops


def test_what_does_not_suit_a_token_policy_is_named(tiny, folder, tmp_path):
    with pytest.raises(ValueError, match="action_head must be one of continuous, tokens, fast, got 'regression'"):
        size = RealSize(policy=folder, action_head="regression")
        REAL_SIZE.policy.make(real(tiny, folder, real_size=size))
    (tmp_path / "config.json").write_text('{"model_type": "openvla"}')
    two = real(tiny, tmp_path, cameras=("agentview", "wrist"))
    with pytest.raises(
        ValueError, match=r"was trained with 1 camera, got 2 \(agentview, wrist\): --sft.cameras agentview"
    ):
        REAL_SIZE.policy.outline(two)
