"""FASTPolicy: what it draws against a slow forward, LOOP on whole chunks against its equations, what learns, files."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from fast_policies import CHUNK_LENGTH, MAX_TOKENS, SIZE, SKIP, VOCABULARY, chunks, fast_policy, fast_words
from hf_models import FAMILIES
from observations import INSTRUCTIONS, observed
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss, rloo_advantage
from worldenv_trl.policies import (
    AutoregressiveActor,
    FASTActionTokenizer,
    FASTConfig,
    FASTPolicy,
    ServedPolicy,
    TeacherForcing,
    policy_actor,
    token_cross_entropy,
)
from worldenv_trl.policies.images import bilinear_resize
from worldenv_trl.row_share import row_share


def drawn(policy: FASTPolicy, td: TensorDict | None = None, **settings) -> TensorDict:
    torch.manual_seed(1)
    actor = AutoregressiveActor(policy, **settings)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        return actor(observed(policy.cameras) if td is None else td)


def slow_log_probs(policy: FASTPolicy, td: TensorDict, temperature: float) -> list[Tensor]:
    """Of each row, [its tokens]: each token by a forward of its own over one row's prompt and what was said before."""
    _, (images, state, texts) = policy.observed(td)
    end, known = policy.action_tokenizer.end, policy.action_tokenizer.known
    allowed = [*range(known), end]
    rows = []
    for row in range(len(td)):
        pixels = policy._pixels({name: image[row : row + 1] for name, image in images.items()})
        ids, valid = policy._prompt_tensors([texts[row]], state[row : row + 1])
        said, scores = [], []
        for token in td[keys.TOKENS][row].tolist():
            said.append(token)
            numbers = torch.tensor([[policy.action_ids[each] for each in said]])
            hidden = policy.backbone(pixels, ids[valid][None], valid[valid][None], numbers)[0, -1]
            logits = hidden @ policy.action_head.weight.T / temperature
            scores.append(logits[token] - logits[allowed].logsumexp(-1))
            if token == end:
                break
        rows.append(torch.stack(scores))
    return rows


# ------------------------------------------------------------------------------------------------------- density


@pytest.mark.parametrize("family", [family for family in FAMILIES if family != "prismatic"])
def test_one_pass_scores_sequences_as_they_were_drawn_one_by_one(family):
    policy, temperature = fast_policy(family), 6.0 if family.startswith("paligemma") else 1.3  # some end early
    td = drawn(policy, temperature=temperature)
    tokens, pad = td[keys.TOKENS], td[keys.TOKEN_IS_PAD]
    assert tokens.dtype == torch.int64 and tokens.shape == pad.shape == td[keys.LOG_PROBS].shape == (6, MAX_TOKENS)
    lengths = (~pad).sum(-1)
    assert lengths.min() < MAX_TOKENS and lengths.unique().numel() > 1  # they end by themselves, and differ
    assert (tokens[pad] == policy.action_tokenizer.end).all() and not td[keys.LOG_PROBS][pad].any()
    assert ((tokens < policy.action_tokenizer.known) | (tokens == policy.action_tokenizer.end)).all()
    assert torch.equal(td[keys.CHUNK], policy.action_tokenizer.decode(tokens))
    scored = AutoregressiveActor(policy, temperature=temperature).get_dist(td).log_prob(tokens).detach()
    torch.testing.assert_close(td[keys.LOG_PROBS][~pad], scored[~pad], rtol=0, atol=1e-5)


def test_scores_are_those_of_one_row_and_one_token_at_a_time():
    policy = fast_policy(prompt_end=(9,))
    td = drawn(policy)
    for row, slow in enumerate(slow_log_probs(policy, td, 1.0)):
        torch.testing.assert_close(td[keys.LOG_PROBS][row, : len(slow)], slow.detach(), rtol=0, atol=1e-5)
        assert bool(td[keys.TOKEN_IS_PAD][row, len(slow) :].all())


def test_the_opening_is_said_behind_a_prompt_that_does_not_see_it():
    """transformers' PaliGemma, the opening among what is causal."""
    policy = fast_policy(lora_rank=0)
    td = drawn(policy)[:1]
    _, (images, state, texts) = policy.observed(td)
    pixels, (ids, _) = policy._pixels(images), policy._prompt_tensors(texts, state)
    opening = fast_words().encode("Action: ", add_special_tokens=False).ids
    assert policy.backbone.opening == tuple(opening) and len(opening) == 2
    model, said = policy.backbone.model, policy.action_ids[td[keys.TOKENS]]
    count = policy.backbone.image_features(pixels[0]).shape[1]
    prompt = torch.tensor([[*[2] * count, 1, *ids[0].tolist()]])
    row = torch.cat([prompt, torch.tensor([opening]), said], 1)
    kinds = torch.tensor([[0] * prompt.shape[1] + [1] * (row.shape[1] - prompt.shape[1])])
    hidden = model(
        input_ids=row, pixel_values=pixels[0], token_type_ids=kinds, attention_mask=torch.ones_like(row)
    ).last_hidden_state[0, -MAX_TOKENS - 1 : -1]
    theirs = hidden @ policy.action_head.weight.T
    theirs[:, policy.action_tokenizer.known : -1] = -torch.inf
    ours = policy.logits(images, state, texts, td[keys.TOKENS])[0]
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=2e-5)


def test_rows_in_a_batch_are_answered_as_one_by_one():
    policy = fast_policy(cameras=("agentview", "wrist"))
    actor = policy_actor(policy)
    together = actor(observed(policy.cameras))
    alone = torch.cat([actor(observed(policy.cameras)[i : i + 1]) for i in range(6)])
    assert torch.equal(together[keys.TOKENS], alone[keys.TOKENS])
    assert torch.equal(together[keys.CHUNK], policy(observed(policy.cameras))[keys.LOC])  # asked as any policy


def test_sequences_are_drawn_as_often_as_they_are_likely():
    policy = fast_policy(max_tokens=4)
    td = drawn(policy, observed(texts=INSTRUCTIONS[0])[:1].expand(3000).contiguous(), temperature=0.5)
    sequences, counts = td[keys.TOKENS].unique(dim=0, return_counts=True)
    place = counts.argmax()
    row = next(i for i in range(3000) if torch.equal(td[keys.TOKENS][i], sequences[place]))
    share, expected = counts[place] / 3000, td[keys.LOG_PROBS][row].sum().exp()
    assert 0.01 < expected < 0.9
    torch.testing.assert_close(share, expected, rtol=0, atol=0.03)


def test_processes_that_share_rows_draw_what_one_would_and_stay_in_step():
    policy, td = fast_policy(), observed()
    whole = drawn(policy, td.clone())
    after = torch.rand(1)
    for rank in range(2):
        with row_share(rank, 2):
            mine = drawn(policy, td[3 * rank : 3 * rank + 3].clone())
        assert torch.equal(mine[keys.TOKENS], whole[keys.TOKENS][3 * rank : 3 * rank + 3])
        assert torch.equal(torch.rand(1), after)  # however soon its own rows ended


def test_in_bfloat16_what_was_drawn_is_scored_again():
    policy = fast_policy(dtype="bfloat16")
    td = drawn(policy)
    scored = AutoregressiveActor(policy).get_dist(td).log_prob(td[keys.TOKENS]).masked_fill(td[keys.TOKEN_IS_PAD], 0)
    assert torch.equal(td[keys.LOG_PROBS], scored.detach())


# ------------------------------------------------------------------------------------------------------- LOOP


def decided(policy: FASTPolicy) -> TensorDict:
    td = drawn(policy)
    td[keys.ADVANTAGE] = torch.tensor([1.0, -1.0, 0.5, -0.5, 2.0, -2.0])[:, None]
    td[keys.STEP_MASK] = torch.arange(CHUNK_LENGTH) < torch.tensor([3, 1, 2, 0, 3, 2])[:, None]
    return td


def loop(policy: FASTPolicy, **settings) -> LOOPLoss:
    loss = LOOPLoss(AutoregressiveActor(policy), **({"functional": False} | settings))
    loss.set_keys(action=keys.TOKENS)
    return loss


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("level", ["token", "chunk"])
def test_loop_is_its_equations_over_whole_chunks(level, functional):
    """All tokens of a chunk count, however many of its steps were executed, and as often as there are such steps."""
    policy = fast_policy()
    td = decided(policy)
    before = [each.detach() for each in slow_log_probs(policy, td, 1.0)]
    with torch.no_grad():  # an update later
        policy.action_head.weight.add_(0.1 * torch.randn(policy.action_head.weight.shape))
    out = loop(policy, clip_epsilon=(0.2, 0.28), ratio_level=level, functional=functional)(td)
    total, clipped, compared = 0.0, 0, 0
    for row, now in enumerate(slow_log_probs(policy, td, 1.0)):
        executed, advantage = int(td[keys.STEP_MASK][row].sum()), td[keys.ADVANTAGE][row, 0]
        if not executed:
            continue
        difference = now - before[row]
        pieces = list(difference) if level == "token" else [difference.sum()] * executed
        for each in pieces:
            ratio = each.exp()
            gain = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.28) * advantage)
            total = total - gain * executed / len(pieces)
            clipped, compared = clipped + (not 0.8 < ratio < 1.28), compared + 1
    expected = total / td[keys.STEP_MASK].sum()
    torch.testing.assert_close(out["loss_objective"], expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(out["clip_fraction"].item(), clipped / compared)
    learning = [policy.action_head.weight, *(each for name, each in policy.named_parameters() if "lora_B" in name)]
    ours, theirs = (torch.autograd.grad(value, learning) for value in (out["loss_objective"], expected))
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-3, atol=1e-5)
    assert ours[0].abs().sum() > 0 and clipped > 0


@pytest.mark.parametrize("level", ["token", "chunk"])
def test_minibatches_add_up_and_ratios_begin_at_one(level):
    policy = fast_policy()
    td = decided(policy)
    loss = loop(policy, ratio_level=level)
    ratio = loss.ratios(td)[keys.RATIO]
    assert ratio.shape == ((6, MAX_TOKENS) if level == "token" else (6, CHUNK_LENGTH))
    torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=0, atol=1e-4)
    td["total_steps"] = td[keys.STEP_MASK].sum().expand(6, 1)
    parts = sum(loss(part)["loss_objective"] for part in td.split(2))
    torch.testing.assert_close(parts, loss(td)["loss_objective"])


def test_padding_and_chunks_of_which_nothing_was_executed_never_reach_the_loss():
    policy = fast_policy()
    td = decided(policy)
    loss = loop(policy, ratio_level="token")
    before = loss(td)["loss_objective"]
    td[keys.TOKENS][3] = 10**6  # no such token
    td[keys.LOG_PROBS][3] = torch.nan
    td[keys.LOG_PROBS][td[keys.TOKEN_IS_PAD]] = 55.0
    torch.testing.assert_close(loss(td)["loss_objective"], before)


@pytest.mark.parametrize("level", ["step", "dim"])
def test_a_ratio_that_whole_chunks_do_not_have_is_refused(level):
    policy = fast_policy()
    with pytest.raises(
        ValueError, match=f"must be chunk or token for tokens that belong to a whole chunk, got {level!r}"
    ):
        loop(policy, ratio_level=level)(decided(policy))


def test_loop_finds_the_rewarded_length():
    """The end is a token like others: what is short can be learned."""
    policy = fast_policy(max_tokens=6)
    groups = policy.post_training_parameters(2)
    actor = policy_actor(policy)
    optimizer = torch.optim.Adam([{"params": groups["adapters"], "lr": 0.01}, {"params": groups["heads"], "lr": 0.03}])
    loss = loop(policy, ratio_level="token", clip_epsilon=0.2)
    contexts = torch.stack([observed()[:2]] * 8, 1)
    torch.manual_seed(2)
    lengths = []
    for _ in range(25):
        with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
            td = actor(contexts.clone())
        returns = -(~td[keys.TOKEN_IS_PAD]).sum(-1).float()
        lengths.append(-returns.mean().item())
        td[keys.ADVANTAGE] = rloo_advantage(returns)[..., None]
        td[keys.STEP_MASK] = torch.ones(2, 8, CHUNK_LENGTH, dtype=torch.bool)
        optimizer.zero_grad()
        loss(td)["loss_objective"].backward()
        optimizer.step()
    assert sum(lengths[-5:]) / 5 < sum(lengths[:5]) / 5 - 0.5


# ------------------------------------------------------------------------------------------------------- learning


def test_cloning_is_the_cross_entropy_of_all_tokens_but_padding():
    policy, td = fast_policy(), observed()
    td[keys.TOKENS] = policy.action_tokenizer.encode(chunks(6))
    td[keys.TOKEN_IS_PAD] = policy.token_is_pad(td[keys.TOKENS])
    loss = BCLoss(TeacherForcing(policy), loss_function=token_cross_entropy)
    loss.set_keys(action=keys.TOKENS, pad_mask=keys.TOKEN_IS_PAD)
    slow = torch.cat(slow_log_probs(policy, td, 1.0))
    torch.testing.assert_close(loss(td)["loss_bc"], -slow.mean(), rtol=1e-4, atol=1e-5)


def test_statistics_and_a_vocabulary_are_taken_from_the_data():
    policy = fast_policy(fixed_tokenizer=False, fitted=False, max_tokens=0, scale=5.0)
    taught = chunks(100) * torch.linspace(0.2, 1, 7)
    states = torch.linspace(-1, 3, 101)[:, None].expand(101, 7)
    policy.fit_statistics(states, taught)
    codec = policy.action_tokenizer
    flat = taught.flatten(0, 1)
    low, high = torch.quantile(flat, torch.tensor([0.01, 0.99]), dim=0)
    torch.testing.assert_close(codec.center.float(), (low + high) / 2)
    torch.testing.assert_close(codec.gain.float(), (high - low) / 2)
    assert codec.scale == 5.0 and codec.known <= SIZE
    error = (codec.decode(codec.encode(taught)) - taught) / codec.gain
    assert error.square().mean(1).sqrt().max() <= 0.1 + 1e-6
    torch.testing.assert_close(policy.state_low, torch.full((7,), -0.96))


@pytest.mark.parametrize("settings", [{"fixed_tokenizer": True}, {"fixed_statistics": True, "fixed_tokenizer": False}])
def test_a_vocabulary_that_is_to_stay_stays(settings):
    policy = fast_policy(**settings)
    before = policy.action_tokenizer.bpe.to_str()
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, CHUNK_LENGTH, 7))
    assert policy.action_tokenizer.bpe.to_str() == before


def test_the_prompt_is_the_policies_own_and_images_are_resized_as_theirs():
    policy = fast_policy(padded_state=9, proprio_format="state")
    seen = []

    class Spy:
        def encode(self, text, **_):
            seen.append(text)
            return fast_words().encode(text)

    policy.tokenizer = Spy()
    policy.state_low.fill_(-1.0)
    policy.state_high.fill_(3.0)
    policy._prompt_tensors(["Open the_drawer\n"], torch.tensor([[-5.0, -1.0, 0.0, 1.0, 2.0, 3.0, 9.0]]))
    assert seen == ["Task: Open the drawer, State: -1 0 64 128 192 255 255 128 128;\n"]
    image = observed()[keys.IMAGE]
    wanted = 2 * bilinear_resize(image, policy.config.resolution) - 1
    torch.testing.assert_close(policy._pixels({"agentview": image})[:, 0], wanted, rtol=0, atol=1e-5)


def test_action_tokens_count_down_from_the_end_of_the_vocabulary():
    """pi0-FAST: token i is the id vocabulary - 1 - skipped - i; the bar ends them."""
    policy = fast_policy()
    expected = [VOCABULARY - 1 - SKIP - token for token in range(SIZE)] + [fast_words().token_to_id("|")]
    assert policy.action_ids.tolist() == expected
    rows = torch.randn(VOCABULARY, policy.backbone.dim)
    policy.take_output_embeddings(rows)
    assert torch.equal(policy.action_head.weight, rows[expected])


# ------------------------------------------------------------------------------------------------------- files, errors


def test_a_saved_policy_reloads_bit_for_bit(tmp_path):
    policy = fast_policy(fixed_tokenizer=False, max_tokens=22, temperature=1.6)
    policy.fit_statistics(torch.randn(50, 7), chunks())
    policy.save_pretrained(tmp_path)
    loaded = FASTPolicy.from_pretrained(tmp_path)
    assert loaded.config == policy.config and loaded.temperature == 1.6
    ours, theirs = drawn(loaded), drawn(policy)
    for key in (keys.TOKENS, keys.CHUNK, keys.LOG_PROBS, keys.TOKEN_IS_PAD):
        assert torch.equal(ours[key], theirs[key])
    (tmp_path / "action_tokenizer.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"no FASTPolicy checkpoint at .*action_tokenizer.json is missing"):
        FASTPolicy.from_pretrained(tmp_path)


def test_tokens_may_stand_for_more_actions_than_are_executed():
    policy = fast_policy(horizon=5, chunk_length=2, max_tokens=0)
    td = drawn(policy)
    assert td[keys.CHUNK].shape == (6, 2, 7) and td[keys.TOKENS].shape == (6, 36)
    assert torch.equal(td[keys.CHUNK], policy.action_tokenizer.decode(td[keys.TOKENS])[:, :2])


def test_a_server_answers_with_the_greedy_chunk():
    policy, td = fast_policy(), observed()
    images = {"agentview": td[keys.IMAGE].numpy()}
    actions, _ = ServedPolicy(policy)(images, td[keys.STATE].numpy(), policy.observed(td)[1][2])
    assert torch.equal(torch.from_numpy(actions), policy_actor(policy)(td)[keys.CHUNK])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fast_vocab_size": 200}, "would have the ids -44 to 155, the backbone knows 0 to 159: a smaller fast_vocab"),
        ({"action_token_end": 170}, "would have the ids 106 to 165, the backbone knows 0 to 159"),
        (
            {"action_token_end": 70},
            "the ids 6 to 65 stand for actions, and the prompt needs .* name another action_tok",
        ),
        ({"end": "<eoa>"}, "the tokenizer has no token '<eoa>', which ends an action chunk"),
        ({"horizon": 2}, "chunk_length must be at least 1 and at most 2, .* got 3"),
        ({"max_tokens": 3}, "max_tokens must be more than chunk_length=3, or 0, got 3"),
        ({"temperature": 0.0}, "temperature must be positive, got 0.0"),
        ({"skip_tokens": -1}, "skip_tokens and padded_state not negative, got 60, 0, -1, 0"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        fast_policy(fitted=False, **settings)


def test_an_action_tokenizer_for_other_chunks_is_refused():
    policy = fast_policy()
    with pytest.raises(
        ValueError, match="is for 8 actions and has 1024 tokens, the policy's horizon is 3 and its fast"
    ):
        FASTPolicy(policy.config, fast_words(), action_tokenizer=FASTActionTokenizer(8))


def test_the_config_is_read_again_as_it_was_written():
    config = fast_policy().config
    assert FASTConfig.from_dict(json.loads(json.dumps(dataclasses.asdict(config)))) == config
