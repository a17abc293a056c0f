"""HFTokenPolicy: what it draws against the models' own forward and a slow one, what learns, what is saved."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from hf_models import IMAGE_ID, RESOLUTION, backbone
from hf_token_policies import BINS, CHUNK_LENGTH, FAMILIES, VOCABULARY, action_words, token_policy
from observations import INSTRUCTIONS, observed
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss

from worldenv_trl import keys
from worldenv_trl.policies import (
    AutoregressiveActor,
    HFPolicy,
    HFTokenConfig,
    HFTokenPolicy,
    ServedPolicy,
    TeacherForcing,
    laplace_actor,
    policy_actor,
    token_cross_entropy,
)
from worldenv_trl.policies.hf_backbone import _qwen_patches

transformers = pytest.importorskip("transformers")

FIRST = VOCABULARY - BINS


def drawn(policy: HFTokenPolicy, td: TensorDict | None = None, **settings) -> TensorDict:
    torch.manual_seed(1)
    actor = AutoregressiveActor(policy, **({"event_dims": 0} | settings))
    with set_exploration_type(ExplorationType.RANDOM):
        return actor(observed(policy.cameras) if td is None else td)


def stir(policy: HFTokenPolicy) -> None:
    """Adapters begin as zero products, whose inner factor gets no gradient."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if "lora_" in name:
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))


def cross_entropy(policy: HFTokenPolicy, td: TensorDict) -> Tensor:
    loss = BCLoss(TeacherForcing(policy), loss_function=token_cross_entropy)
    loss.set_keys(action=keys.TOKENS, pad_mask=keys.ACTION_IS_PAD)
    return loss(td)["loss_bc"]


# ------------------------------------------------------------------------------------------------------- density


@pytest.mark.parametrize("temperature", [1.0, 1.6])
@pytest.mark.parametrize("family", FAMILIES)
def test_one_pass_scores_tokens_as_they_were_drawn_one_by_one(family, temperature):
    policy = token_policy(family)
    stir(policy)
    td = drawn(policy, temperature=temperature)
    assert td[keys.TOKENS].dtype == torch.int64 and td[keys.TOKENS].shape == (6, CHUNK_LENGTH, 7)
    assert not td[keys.LOG_PROBS].requires_grad
    scored = AutoregressiveActor(policy, temperature=temperature, event_dims=0).get_dist(td).log_prob(td[keys.TOKENS])
    torch.testing.assert_close(td[keys.LOG_PROBS], scored.detach(), rtol=0, atol=1e-5)
    assert td[keys.TOKENS].flatten(1).unique(dim=0).shape[0] == 6  # rows differ


@pytest.mark.parametrize("family", [family for family in FAMILIES if family != "prismatic"])
@torch.no_grad()
def test_logits_are_the_rows_of_the_models_own_language_head(family, tmp_path):
    """transformers' model on whole ids, without any cache, once for every token."""
    torch.manual_seed(3)
    whole = transformers.AutoModelForImageTextToText.from_config(backbone(family)).eval()
    text = whole.config.get_text_config()
    if family == "paligemma2":
        text.final_logit_softcapping = 0.5
    whole.save_pretrained(tmp_path)
    action_words(not family.startswith("qwen")).save(str(tmp_path / "tokenizer.json"))
    settings = {"num_bins": BINS, "action_token_end": VOCABULARY, "chunk_length": 1, "lora_rank": 0, "image_size": 64}
    policy = HFTokenPolicy.from_backbone(tmp_path, resolution=RESOLUTION, **settings)
    td = drawn(policy, observed(texts=INSTRUCTIONS[1])[:1])
    ours = AutoregressiveActor(policy, event_dims=0).get_dist(td).base_dist.logits[0, 0]

    _, (images, state, texts) = policy.observed(td)
    pixels, (ids, _) = policy._pixels(images), policy._prompt_tensors(texts, state)
    tokens = policy.backbone.image_features(pixels[0]).shape[1]
    around = {"idefics3": ([3, 4], [3]), "smolvlm": ([3, 4], [3]), "qwen2_vl": ([5], [6]), "qwen2_5_vl": ([5], [6])}
    before, after = around.get(family, ([], []))
    front, first = [*before, *tokens * [IMAGE_ID], *after], [] if family.startswith("qwen") else [1]
    front = [*front, *first] if family.startswith("paligemma") else [*first, *front]
    prompt, said = [*front, *ids[0].tolist()], (td[keys.TOKENS][0, 0] + FIRST).tolist()
    for place in range(7):
        row = torch.tensor([[*prompt, *said[:place]]])
        extra = {"pixel_values": pixels[0]}
        if family in ("idefics3", "smolvlm"):
            extra = {"pixel_values": pixels}
        elif family.startswith("paligemma"):
            extra["token_type_ids"] = torch.tensor([[0] * len(prompt) + [1] * place])  # behind the prompt: causal
        elif family.startswith("qwen"):
            patches, grid = _qwen_patches(pixels[0], whole.model.config.vision_config)
            extra = {"pixel_values": patches, "image_grid_thw": grid, "mm_token_type_ids": (row == IMAGE_ID).int()}
        theirs = whole(input_ids=row, attention_mask=torch.ones_like(row), **extra).logits[0, -1, FIRST:]
        torch.testing.assert_close(ours[place], theirs.log_softmax(-1), rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("family", FAMILIES)
@torch.no_grad()
def test_rows_in_a_batch_are_answered_as_one_by_one(family):
    policy = token_policy(family, cameras=("agentview", "wrist"))
    td = observed(policy.cameras)
    actor = AutoregressiveActor(policy, event_dims=0)
    together = actor(td.clone())  # greedy: nothing is drawn
    alone = torch.cat([actor(td[i : i + 1].clone()) for i in range(6)])
    assert torch.equal(together[keys.TOKENS], alone[keys.TOKENS])
    for each in (together, alone):
        each[keys.LOG_PROBS] = actor.get_dist(each).log_prob(each[keys.TOKENS])
    torch.testing.assert_close(together[keys.LOG_PROBS], alone[keys.LOG_PROBS], rtol=0, atol=1e-5)


@torch.no_grad()
def test_tokens_are_drawn_as_often_as_they_are_likely():
    policy = token_policy(chunk_length=1)
    td = observed(texts=INSTRUCTIONS[0])[:1].expand(4000).contiguous()
    td = drawn(policy, td, temperature=2.0)
    first = td[keys.TOKENS][:, 0, 0]
    expected = AutoregressiveActor(policy, temperature=2.0).get_dist(td[:1]).base_dist.logits[0, 0, 0].exp()
    shares = torch.stack([(first == token).float().mean() for token in range(BINS)])
    torch.testing.assert_close(shares, expected, rtol=0, atol=0.03)
    assert expected.max() < 0.9 and (expected > 0.02).sum() >= 4  # it is no matter of course


@torch.no_grad()
def test_greedy_tokens_are_each_the_likeliest_after_those_before():
    policy = token_policy()
    actor = policy_actor(policy)
    td = actor(observed())
    logits = actor.get_dist(td).base_dist.logits
    assert torch.equal(td[keys.TOKENS], logits.argmax(-1))
    assert torch.equal(td[keys.CHUNK], policy.action_tokenizer.decode(td[keys.TOKENS]))
    assert torch.equal(td[keys.CHUNK], policy(observed())[keys.LOC])  # asked as any policy


@torch.no_grad()
def test_what_was_drawn_before_counts_and_what_comes_after_does_not():
    policy = token_policy()
    td = drawn(policy)
    other = td.clone()
    other[keys.TOKENS][:, 0, 3] = (other[keys.TOKENS][:, 0, 3] + 5) % BINS
    first, second = (AutoregressiveActor(policy).get_dist(each).base_dist.logits.flatten(1, 2) for each in (td, other))
    assert torch.equal(first[:, :4], second[:, :4])
    assert not torch.allclose(first[:, 4:], second[:, 4:], atol=1e-3)


def test_any_batch_shape_will_do():
    policy = token_policy(chunk_length=1)
    td = drawn(policy, observed().reshape(2, 3), event_dims=1)
    assert td[keys.TOKENS].shape == (2, 3, 1, 7) and td[keys.LOG_PROBS].shape == (2, 3, 1)
    flat = drawn(policy, event_dims=0)
    torch.testing.assert_close(td[keys.LOG_PROBS].flatten(), flat[keys.LOG_PROBS].sum(-1).flatten())
    assert AutoregressiveActor(policy).get_dist(td).log_prob(td[keys.TOKENS]).shape == (2, 3, 1)


@torch.no_grad()
def test_checkpointed_layers_keep_what_came_before_in_training_too():
    policies = [token_policy(family="smolvlm", gradient_checkpointing=again) for again in (False, True)]
    ours, theirs = (drawn(policy.train())[keys.TOKENS] for policy in policies)
    assert torch.equal(ours, theirs)
    assert all(module.training for module in policies[1].modules())


def test_in_bfloat16_what_is_drawn_is_scored_by_the_pass_that_learns():
    policy = token_policy(dtype="bfloat16")
    td = drawn(policy)
    actor = AutoregressiveActor(policy, event_dims=0)
    assert torch.equal(td[keys.LOG_PROBS], actor.get_dist(td).log_prob(td[keys.TOKENS]).detach())
    assert policy.action_head.weight.dtype == torch.float32
    single = token_policy()
    single.load_state_dict(policy.state_dict())
    close = AutoregressiveActor(single, event_dims=0).get_dist(td).log_prob(td[keys.TOKENS])
    assert (td[keys.LOG_PROBS] - close).abs().mean() < 0.05


# ------------------------------------------------------------------------------------------------------- learning


@pytest.mark.parametrize("family", FAMILIES)
def test_gradients_reach_adapters_and_what_reads_tokens_out_and_nothing_else(family):
    policy = token_policy(family)
    groups = policy.post_training_parameters(2)
    stir(policy)
    td = drawn(policy)
    policy_actor(policy).get_dist(td).log_prob(td[keys.TOKENS]).sum().backward()
    learning = {id(parameter) for group in groups.values() for parameter in group}
    unread = "vision_tower.encoder.layers.1." if family == "llava" else "never"  # LLaVA reads the last but one layer
    for name, parameter in policy.named_parameters():
        if id(parameter) not in learning:
            assert not parameter.requires_grad and parameter.grad is None, name
        elif unread not in name:
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    assert {"adapters", "heads"} == set(groups) and len(groups["heads"]) == 1 and len(groups["adapters"]) > 20
    full = token_policy(family, lora_rank=0).post_training_parameters(0)
    assert set(full) == {"backbone", "heads"}


@pytest.mark.parametrize("checkpointing", [False, True])
@pytest.mark.filterwarnings("ignore:The name target_actor_network_params")
def test_cloning_is_the_mean_cross_entropy_of_the_unpadded_tokens(checkpointing):
    policy = token_policy(gradient_checkpointing=checkpointing)
    stir(policy)
    td = observed()
    td[keys.TOKENS] = torch.randint(BINS, (6, CHUNK_LENGTH, 7), generator=torch.Generator().manual_seed(2))
    td[keys.ACTION_IS_PAD] = torch.tensor([[False, row % 2 == 1] for row in range(6)])
    value = cross_entropy(policy, td)
    value.backward()
    logits = AutoregressiveActor(policy).get_dist(td).base_dist.logits
    each = -logits.gather(-1, td[keys.TOKENS][..., None])[..., 0]  # [6, C, 7]
    expected = torch.cat([each[row, : 1 if row % 2 else 2].flatten() for row in range(6)]).mean()
    torch.testing.assert_close(value, expected)
    adapters = [parameter for name, parameter in policy.named_parameters() if "lora_" in name]
    ours = [parameter.grad for parameter in (*adapters, policy.action_head.weight)]
    theirs = torch.autograd.grad(expected, [*adapters, policy.action_head.weight], allow_unused=True)
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-6)


@pytest.mark.filterwarnings("ignore:The name target_actor_network_params")
def test_a_few_steps_of_cloning_teach_the_demonstrated_tokens():
    policy = token_policy(chunk_length=1)
    policy.fit_statistics(torch.randn(50, 7), torch.rand(200, 7) - 0.5)
    td = observed()
    actions = torch.linspace(-0.45, 0.45, 6)[:, None, None].expand(-1, 1, 7).contiguous()
    td[keys.TOKENS] = policy.action_tokenizer.encode(actions)
    optimizer = torch.optim.Adam([parameter for parameter in policy.parameters() if parameter.requires_grad], 0.02)
    values = []
    for _ in range(25):
        optimizer.zero_grad()
        value = cross_entropy(policy, td.clone())
        value.backward()
        optimizer.step()
        values.append(value.item())
    assert values[0] > 2 and values[-1] < 0.3
    bin_width = 1.0 / (BINS - 1)
    assert (policy(observed())[keys.LOC] - actions).abs().max() < 1.5 * bin_width


def test_statistics_map_the_quantiles_to_the_outer_bins():
    policy = token_policy()
    actions = torch.linspace(-0.5, 0.1, 1001)[:, None].expand(-1, 7).contiguous()
    policy.fit_statistics(torch.randn(10, 7), actions)
    half = 0.294
    center = half / (BINS - 1)  # of a bin, from its edge
    ends = policy.action_tokenizer.decode(torch.tensor([[BINS - 1] * 7, [0] * 7]))
    torch.testing.assert_close(ends[0], torch.full((7,), -0.494 + center))
    torch.testing.assert_close(ends[1], torch.full((7,), 0.094 - center))
    torch.testing.assert_close(policy.action_range, torch.full((7,), half))


# ------------------------------------------------------------------------------------------------------- prompts, files


def test_a_prompt_with_the_state_tells_it_in_bins():
    policy = token_policy(prompt="{instruction} : {state} ?")
    policy.state_low.fill_(-1.0)
    policy.state_high.fill_(3.0)
    seen = []

    class Spy:
        def encode(self, text, **_):
            seen.append(text)
            return action_words().encode(text)

    policy.tokenizer = Spy()
    policy._prompt_tensors(["Open the drawer"], torch.tensor([[-5.0, -1.0, 0.0, 1.0, 2.0, 3.0, 9.0]]))
    assert seen == ["open the drawer : 0 0 64 128 192 255 255 ?"]


def test_prompts_of_several_lengths_with_states_change_nothing_for_each_other():
    policy = token_policy(prompt="{instruction} : {state} ?", prompt_end=(9,))
    actor = policy_actor(policy)
    together = actor(observed())
    alone = torch.cat([actor(observed()[i : i + 1]) for i in range(6)])
    assert torch.equal(together[keys.TOKENS], alone[keys.TOKENS])


@pytest.mark.parametrize("family", ["smolvlm", "prismatic", "qwen2_vl"])
def test_a_saved_policy_reloads_bit_for_bit(family, tmp_path):
    policy = token_policy(family, temperature=1.6)
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 7))
    stir(policy)
    policy.save_pretrained(tmp_path)
    loaded = HFTokenPolicy.from_pretrained(tmp_path)
    assert loaded.config == policy.config and loaded.temperature == 1.6
    ours, theirs = drawn(loaded), drawn(policy)
    for key in (keys.TOKENS, keys.CHUNK, keys.LOG_PROBS):
        assert torch.equal(ours[key], theirs[key])
    with pytest.raises(ValueError, match=r"holds HFTokenPolicy, not HFPolicy: use HFTokenPolicy\.from_pretrained"):
        HFPolicy.from_pretrained(tmp_path)


def test_a_tokenizer_that_lacks_action_tokens_is_refused_with_their_ids():
    with pytest.raises(ValueError, match="has no token of the ids 40 to 63, and 32 to 63 stand for actions"):
        config = dataclasses.replace(token_policy().config, num_bins=32)
        HFTokenPolicy(config, action_words(size=40))


def test_the_tokenizers_own_vocabulary_ends_with_the_action_tokens_unless_told_otherwise():
    policy = token_policy(action_token_end=0)
    assert policy.first_action_id == FIRST
    assert token_policy(action_token_end=60).first_action_id == 60 - BINS


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_bins": 100}, "would have the ids -36 to 63, the backbone knows 0 to 63: name fewer num_bins"),
        ({"action_token_end": 70}, "would have the ids 54 to 69, the backbone knows 0 to 63"),
        (
            {"action_token_end": 18},
            r"the ids 2 to 17 stand for actions, and the prompt needs .*'<global-img>' among them",
        ),
        ({"prompt_end": (63,)}, r"the ids 48 to 63 stand for actions, and the prompt needs '<action\d+>' among them"),
        ({"num_bins": 1}, "num_bins must be at least 2 and action_token_end not negative, got 1, 64"),
        ({"temperature": 0.0}, "temperature must be positive, got 0.0"),
        ({"dtype": "float16"}, "'float32' or 'bfloat16', got 'float16'"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        token_policy(**settings)


def test_other_actors_are_refused_with_the_one_that_suits():
    with pytest.raises(TypeError, match="HFTokenPolicy acts by tokens and has no Laplace density: use policy_actor"):
        laplace_actor(token_policy())
    with pytest.raises(ValueError, match=r"temperature must be positive, got 0.0; for greedy actions use"):
        AutoregressiveActor(token_policy(), temperature=0.0)
    with pytest.raises(ValueError, match="event_dims must be 0 or 1, got 2"):
        AutoregressiveActor(token_policy(), event_dims=2)


def test_a_server_answers_with_the_greedy_chunk():
    policy, td = token_policy(), observed()
    images = {"agentview": td[keys.IMAGE].numpy()}
    actions, _ = ServedPolicy(policy)(images, td[keys.STATE].numpy(), policy.observed(td)[1][2])
    assert torch.equal(torch.from_numpy(actions), policy_actor(policy)(td)[keys.CHUNK])


def test_a_missing_camera_is_named():
    policy = token_policy(cameras=("agentview", "wrist"))
    with pytest.raises(ValueError, match="trained for the cameras agentview, wrist; the tensordict has no"):
        policy_actor(policy)(observed())


def test_the_config_is_read_again_as_it_was_written():
    config = token_policy().config
    assert HFTokenConfig.from_dict(json.loads(json.dumps(dataclasses.asdict(config)))) == config
