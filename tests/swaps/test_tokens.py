"""A policy that acts by tokens through the same recipe: cloned by cross-entropy, post-trained by LOOP on its tokens."""

from __future__ import annotations

import dataclasses

import pytest

pytest.importorskip("transformers")

import torch
from policies import hf_models
from policies.hf_token_policies import VOCABULARY, action_words

from parts import COMPACT, Part, instructions
from run_folder import RunFolder
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
    config = dataclasses.replace(tiny, post_train=learning)
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
