"""LeRobot's pi0-FAST: what its own code made of a folder, and what is wrong with folders."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from lerobot_fast_folder import SIZE, SKIP, VOCABULARY, fast_reference, save_fast_folder
from lerobot_folders import CAMERAS, SIDE, observations

from worldenv_trl import keys
from worldenv_trl.policies import FASTPolicy, load_lerobot, policy_actor


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_fast_folder(tmp_path_factory.mktemp("pi0_fast"))


def loaded(folder, **settings) -> FASTPolicy:
    return load_lerobot(folder, **({"image_size": SIDE, "dtype": "float32", "lora_rank": 0} | settings))


@torch.no_grad()
def test_it_says_what_lerobots_own_code_says(folder):
    policy, reference, td = loaded(folder), fast_reference(), observations()
    assert isinstance(policy, FASTPolicy) and policy.cameras == CAMERAS
    greedy = policy_actor(policy)(td.clone())[keys.TOKENS]
    wanted = torch.tensor(reference["greedy"])
    assert torch.equal(greedy[:, : wanted.shape[1]], wanted)

    tokens = torch.tensor(reference["tokens"])
    end = policy.action_tokenizer.end
    padded = torch.full((2, policy.action_tokenizer.max_tokens), end)
    padded[:, : tokens.shape[1]] = tokens
    _, observed = policy.observed(td)
    ours = policy.logits(*observed, padded)[:, : tokens.shape[1], [*range(policy.action_tokenizer.known), end]]
    theirs = torch.tensor(reference["logits"])
    assert theirs.std() > 0.1 and (theirs[0] - theirs[1]).abs().max() > 0.1
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-4)


@torch.no_grad()
def test_its_tokens_are_the_actions_that_lerobots_own_code_makes_of_them(folder):
    policy, reference = loaded(folder), fast_reference()
    wanted = torch.tensor(reference["actions"])
    assert wanted.std() > 0.1
    torch.testing.assert_close(policy.decode(torch.tensor(reference["tokens"])), wanted, rtol=0, atol=1e-5)


def test_settings_are_the_folders(folder):
    policy = loaded(folder)
    assert policy.chunk_length == policy.config.horizon == 6 and policy.token_shape == (43,)
    assert policy.action_ids.tolist()[0] == VOCABULARY - 1 - SKIP and len(policy.action_ids) == SIZE + 1
    before = policy.action_tokenizer.bpe.to_str(), policy.action_tokenizer.center.clone()
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 6, 7))
    assert policy.action_tokenizer.bpe.to_str() == before[0] and torch.equal(policy.action_tokenizer.center, before[1])
    fitted = loaded(folder, fixed_statistics=False)
    fitted.fit_statistics(torch.randn(50, 7), torch.randn(50, 6, 7))
    assert fitted.action_tokenizer.bpe.to_str() == before[0]  # its weights speak this vocabulary
    assert not torch.equal(fitted.action_tokenizer.center, before[1])


def test_an_outline_reads_no_weights_and_has_the_same_shapes(folder):
    made, outline = loaded(folder, lora_rank=2), loaded(folder, lora_rank=2, device="meta")
    shapes = {name: (value.shape, value.dtype) for name, value in made.named_parameters()}
    assert {name: (value.shape, value.dtype) for name, value in outline.named_parameters()} == shapes
    assert {each.device.type for each in outline.parameters()} == {"meta"}


def test_adapters_and_bfloat16_learn(folder):
    policy = loaded(folder, lora_rank=2, dtype="bfloat16")
    groups = policy.post_training_parameters(2)
    assert {each.dtype for group in groups.values() for each in group} == {torch.float32}
    _, observed = policy.observed(observations())
    tokens = torch.zeros(2, *policy.token_shape, dtype=torch.int64)
    policy.logits(*observed, tokens).logsumexp(-1).sum().backward()
    assert policy.action_head.weight.grad.abs().sum() > 0


def test_a_saved_policy_reloads(folder, tmp_path):
    policy = loaded(folder)
    policy.save_pretrained(tmp_path)
    again, td = FASTPolicy.from_pretrained(tmp_path), observations()
    assert torch.equal(policy_actor(again)(td.clone())[keys.TOKENS], policy_actor(policy)(td)[keys.TOKENS])


@pytest.mark.parametrize("name", ["action_tokenizer/processor_config.json", "action_tokenizer/tokenizer.json"])
def test_a_missing_file_of_the_action_tokenizer_is_named(folder, tmp_path, name):
    broken = shutil.copytree(folder, tmp_path / "broken")
    (broken / name).unlink()
    with pytest.raises(FileNotFoundError, match=r"does not hold FAST's tokenizer, .* action_tokenizer= a folder"):
        loaded(broken)
    assert loaded(broken, action_tokenizer=folder / "action_tokenizer").action_tokenizer.size == SIZE


def test_chunks_of_another_length_than_the_tokenizers_are_refused(folder, tmp_path):
    broken = shutil.copytree(folder, tmp_path / "broken")
    path = broken / "action_tokenizer" / "processor_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"time_horizon": 50}))
    with pytest.raises(ValueError, match="time_horizon is 50, the policy's chunks have 6"):
        loaded(broken)
    with pytest.raises(ValueError, match=r"chunk_length must be at least 1 and at most 6, .* got 8"):
        loaded(folder, chunk_length=8)
