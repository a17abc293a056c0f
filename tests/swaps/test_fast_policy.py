"""A policy that says whole chunks in FAST's tokens through the same recipe: its vocabulary trained, cloned, explored
with, post-trained by LOOP, evaluated."""

from __future__ import annotations

import dataclasses

import pytest

pytest.importorskip("transformers")

import torch
from policies import hf_models
from policies.fast_policies import fast_words
from policies.lerobot_fast_folder import save_fast_folder
from safetensors.torch import load_file
from transformers import AutoModelForImageTextToText

from checks import check_loop
from config import RealSize
from parts import COMPACT
from published_sizes import outlined_policy
from real_parts import REAL_SIZE
from rehearsal import rehearse
from run_folder import RunFolder
from serve import load_policy
from stages import plan
from world_env import run_all
from worldenv_trl import keys
from worldenv_trl.policies import FASTActionTokenizer, FASTPolicy
from worldenv_trl.record import read_rollouts

WORDS = 1400  # of the vocabulary: 1,024 action tokens and 128 that are skipped


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A PaliGemma as ``save_pretrained`` writes it."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("paligemma")
    network = hf_models.backbone("paligemma")
    network.text_config.vocab_size = WORDS
    AutoModelForImageTextToText.from_config(network).save_pretrained(path)
    fast_words(WORDS).save(str(path / "tokenizer.json"))
    return path


def real(tiny, path, level="token", **named):
    """The compact preset's sizes with the policy of a folder."""
    real_size = RealSize(policy=path, action_head="fast", dtype="float32", **named)
    learning = dataclasses.replace(tiny.post_train, ratio_level=level, lora_rank=2)
    return dataclasses.replace(tiny, parts="real-size", real_size=real_size, post_train=learning)


PARTS = dataclasses.replace(COMPACT, policy=REAL_SIZE.policy)


@pytest.mark.parametrize("level", ["token", "chunk"])
def test_a_fast_policy_is_cloned_post_trained_and_evaluated(tiny, folder, capsys, monkeypatch, level):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    config = real(tiny, folder, level)
    explore = dataclasses.replace(tiny.explore, scale_factors=(0.0, 1.0))
    config = dataclasses.replace(config, explore=explore)
    run_all(config, PARTS)
    run = RunFolder(config.run_dir)
    assert all(run.done(stage.name) for stage in plan(config))
    told = capsys.readouterr()
    assert "missing in the report" not in told.out and "the report could not be written" not in told.err
    assert any("cross_entropy" in line for line in run.read_metrics("sft"))
    before, after = (FASTPolicy.from_pretrained(run.checkpoint(name)) for name in ("sft", "post_train"))
    assert before.action_tokenizer.min_token < 0 < before.action_tokenizer.known < 1024  # trained on the demonstrations
    assert after.action_tokenizer.bpe.to_str() == before.action_tokenizer.bpe.to_str()
    changed = {name for name, value in after.state_dict().items() if not torch.equal(value, before.state_dict()[name])}
    assert changed and all("lora_" in name or "action_head" in name for name in changed)

    wave = read_rollouts(run.rollouts("post_train_000"))[0]  # of the weights that learned from it: the first ones
    wave = wave[wave[keys.MASK]]
    tokens, padding = wave[keys.TOKENS], wave[keys.TOKEN_IS_PAD]
    assert tokens.shape == padding.shape == wave[keys.LOG_PROBS].shape == (len(wave), 8 * 7 + 1)
    assert torch.equal(padding, before.token_is_pad(tokens)) and torch.equal(wave[keys.CHUNK], before.decode(tokens))
    assert wave[keys.RATIO].shape == (tokens.shape if level == "token" else (len(wave), 8))
    _, observed = before.observed(wave)
    with torch.no_grad():
        scored = before.logits(*observed, tokens).log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
    torch.testing.assert_close(wave[keys.LOG_PROBS][~padding], scored[~padding], rtol=1e-4, atol=1e-4)


def test_the_setting_makes_a_fast_policy_of_a_folder(tiny, folder, tmp_path):
    config = real(tiny, folder)
    made, outline = REAL_SIZE.policy.make(config), REAL_SIZE.policy.outline(config)
    assert isinstance(made, FASTPolicy) and made.chunk_length == made.config.horizon == config.chunk_length
    saved = load_file(folder / "model.safetensors")
    rows = next(value for name, value in saved.items() if name.endswith(("lm_head.weight", "embed_tokens.weight")))
    assert torch.equal(made.action_head.weight[:3], rows[[WORDS - 129, WORDS - 130, WORDS - 131]])
    shapes = {name: (value.shape, value.dtype) for name, value in made.named_parameters()}
    assert {name: (value.shape, value.dtype) for name, value in outline.named_parameters()} == shapes
    assert {each.device.type for each in outline.parameters()} == {"meta"}
    made.save_pretrained(tmp_path / "saved")
    for loaded in (
        REAL_SIZE.policy.load(tmp_path / "saved"),
        load_policy(str(tmp_path / "saved"), torch.device("cpu")),
    ):
        assert isinstance(loaded, FASTPolicy) and torch.equal(loaded.action_head.weight, made.action_head.weight)


def test_a_tokenizer_that_is_named_stays(tiny, folder, tmp_path):
    codec = FASTActionTokenizer(8, size=700)
    codec.fit(torch.linspace(-1, 1, 9)[:, None, None].expand(9, 8, 7), scale=6.0)
    codec.save_pretrained(tmp_path)
    policy = REAL_SIZE.policy.make(real(tiny, folder, action_tokenizer=str(tmp_path)))
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 8, 7))
    assert policy.action_tokenizer.bpe.to_str() == codec.bpe.to_str() and policy.action_tokenizer.scale == 6.0
    assert policy.action_head.weight.shape[0] == 701
    with pytest.raises(ValueError, match="time_horizon is 8, the policy's chunks have 4"):
        REAL_SIZE.policy.outline(
            dataclasses.replace(real(tiny, folder, action_tokenizer=str(tmp_path)), chunk_length=4)
        )


@pytest.mark.parametrize("published", [False, True])
def test_a_decision_of_whole_chunks_is_planned(tiny, folder, published):
    config = real(tiny, folder)
    found = rehearse(config, PARTS, {"policy": outlined_policy} if published else None)
    assert not found.problems and "policy: agentview uint8 [2, 3, 64, 64] -> chunk float32 [2, 8, 7]" in found.shapes
    assert found.calls["decide"].read_bytes > 20 * found.calls["score"].read_bytes  # at most, with no end before L
    assert found.calls["decide"].flops == pytest.approx(found.calls["score"].flops, rel=0.2)


def test_a_ratio_of_steps_is_refused_before_long_work(tiny, folder):
    config = real(tiny, folder, level="step")
    with pytest.raises(ValueError, match=r"ratio_level must be chunk or token for FASTPolicy, .* got 'step'"):
        check_loop(config, REAL_SIZE.policy.outline(config))


def test_lerobots_pi0_fast_is_known_by_its_files(tiny, tmp_path):
    path = save_fast_folder(tmp_path / "pi0_fast")
    config = dataclasses.replace(real(tiny, path), chunk_length=6, max_steps=12, cameras=("agentview", "wrist"))
    for head in ("fast", "continuous"):  # the latter is what nobody has said
        chosen = dataclasses.replace(config, real_size=dataclasses.replace(config.real_size, action_head=head))
        assert isinstance(REAL_SIZE.policy.make(chosen), FASTPolicy)
    assert isinstance(load_policy(str(path), torch.device("cpu")), FASTPolicy)
    other = dataclasses.replace(config, real_size=dataclasses.replace(config.real_size, action_head="tokens"))
    with pytest.raises(ValueError, match=r"does not act by such tokens: --real-size\.action-head fast"):
        REAL_SIZE.policy.make(other)
