"""Actors over tokens, and LOOP on them, against closed forms and a slow loop."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data.vla import UniformActionTokenizer, VocabTailActionTokenizer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.vla import TinyVLA

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss, rloo_advantage
from worldenv_trl.policies import TokenActor, token_actor

ROWS, C, A, V = 6, 4, 7, 8
TOKENIZER = UniformActionTokenizer(V, low=-1.0, high=1.0)


class Table(nn.Module):
    """Logits of its own for every row, token and bin."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.logits = nn.Parameter(torch.randn(ROWS, C, A, V, generator=generator))

    def forward(self, row):
        return self.logits[row.squeeze(-1)]


def make_actor(**settings) -> tuple[TokenActor, nn.Parameter]:
    table = Table()
    network = TensorDictModule(table, in_keys=["row"], out_keys=[keys.LOGITS])
    return token_actor(network, TOKENIZER, **settings), table.logits


def rows() -> TensorDict:
    return TensorDict({"row": torch.arange(ROWS)[:, None]}, [ROWS])


def decided(actor: TokenActor, spread: float = 0.0) -> TensorDict:
    torch.manual_seed(1)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        td = actor(rows())
    td[keys.LOG_PROBS] = td[keys.LOG_PROBS] + spread * torch.randn_like(td[keys.LOG_PROBS])
    td[keys.ADVANTAGE] = torch.tensor([1.0, -1.0, 0.5, -0.5, 2.0, -2.0])[:, None]
    td[keys.STEP_MASK] = torch.arange(C) < torch.tensor([4, 2, 4, 1, 3, 4])[:, None]
    return td


def loop(actor: TokenActor, **settings) -> LOOPLoss:
    loss = LOOPLoss(actor, **({"functional": False} | settings))
    loss.set_keys(action=keys.TOKENS)
    return loss


@pytest.mark.parametrize("temperature", [1.0, 1.6])
def test_tokens_are_scored_by_the_softmax_they_are_drawn_from(temperature):
    actor, logits = make_actor(temperature=temperature)
    td = decided(actor)
    tokens = td[keys.TOKENS]
    assert tokens.dtype == torch.int64 and tokens.shape == (ROWS, C, A)
    expected = (logits / temperature).log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
    torch.testing.assert_close(td[keys.LOG_PROBS], expected)
    assert torch.equal(td[keys.CHUNK], TOKENIZER.decode(tokens))
    draws = actor.get_dist(rows()).sample((20000,))
    shares = torch.stack([(draws == token).float().mean(0) for token in range(V)], -1)
    torch.testing.assert_close(shares, (logits / temperature).softmax(-1).detach(), rtol=0, atol=0.02)


def test_greedy_tokens_are_the_likeliest():
    actor, logits = make_actor()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = actor(rows())
    assert torch.equal(td[keys.TOKENS], logits.argmax(-1))
    assert torch.equal(td[keys.CHUNK], TOKENIZER.decode(logits.argmax(-1)))


@pytest.mark.parametrize("normalized", [True, False])
def test_openvlas_tokens_become_its_actions(normalized):
    """256 ids at the vocabulary's tail, their bins' centres, and q01/q99 of all but the gripper."""
    low, high = torch.linspace(-0.9, -0.3, A), torch.linspace(0.2, 0.8, A)
    mask = torch.tensor([True] * 6 + [False])
    bounds = {"norm_low": low, "norm_high": high, "norm_mask": mask} if normalized else {}
    network = TensorDictModule(
        lambda row: (
            torch.nn.functional.one_hot(((row + torch.arange(C * A)) * 9) % 255 + 1, 256).view(-1, C, A, 256) * 9.0
        ),
        in_keys=["row"],
        out_keys=[keys.LOGITS],
    )
    actor = token_actor(network, VocabTailActionTokenizer(256, **bounds))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = actor(rows())
    digit = 256 - td[keys.TOKENS]  # 1 to 255: np.digitize of the action between 256 edges
    edge = -1 + (digit - 1) * 2 / 255
    expected = edge + 1 / 255
    if normalized:
        expected = torch.where(mask, 0.5 * (expected + 1) * (high - low + 1e-8) + low, expected)
    torch.testing.assert_close(td[keys.CHUNK], expected)


@pytest.mark.parametrize("level", ["token", "chunk", "step"])
def test_loop_is_its_equations_token_by_token(level):
    actor, logits = make_actor(temperature=1.3)
    td = decided(actor, spread=0.3)
    out = loop(actor, clip_epsilon=(0.2, 0.28), ratio_level=level)(td)
    now = (logits / 1.3).log_softmax(-1).gather(-1, td[keys.TOKENS][..., None])[..., 0]
    total = 0.0
    for row in range(ROWS):
        executed, advantage = int(td[keys.STEP_MASK][row].sum()), td[keys.ADVANTAGE][row, 0]
        difference = (now - td[keys.LOG_PROBS])[row, :executed]  # [T, 7]
        for step in range(executed):
            groups = {"token": list(difference[step]), "step": [difference[step].sum()], "chunk": [difference.sum()]}
            for each in groups[level]:
                ratio = each.exp()
                clipped = ratio.clamp(0.8, 1.28)
                total = total - torch.minimum(ratio * advantage, clipped * advantage) / len(groups[level])
    expected = total / td[keys.STEP_MASK].sum()
    torch.testing.assert_close(out["loss_objective"], expected)
    ours, theirs = (torch.autograd.grad(value, logits)[0] for value in (out["loss_objective"], expected))
    torch.testing.assert_close(ours, theirs)
    assert ours.abs().sum() > 0 and out["clip_fraction"] > 0


@pytest.mark.parametrize("functional", [True, False])
def test_the_first_gradient_is_the_policy_gradients(functional):
    """At the policy that acted every ratio is one: d log softmax / d logits = one-hot minus probability."""
    actor, logits = make_actor()
    td = decided(actor)
    loop(actor, ratio_level="token", functional=functional)(td)["loss_objective"].backward()
    one_hot = torch.nn.functional.one_hot(td[keys.TOKENS], V)
    executed = td[keys.STEP_MASK][..., None, None]
    pull = td[keys.ADVANTAGE][:, :, None, None] * (one_hot - logits.softmax(-1)).detach()
    expected = -torch.where(executed, pull, 0.0) / (A * td[keys.STEP_MASK].sum())
    torch.testing.assert_close(logits.grad, expected)


def test_tokens_that_were_not_executed_never_reach_the_loss():
    actor, _ = make_actor()
    td = decided(actor)
    loss = loop(actor, ratio_level="token")
    before = loss(td)["loss_objective"]
    td[keys.TOKENS] = torch.where(td[keys.STEP_MASK][..., None], td[keys.TOKENS], 10**6)  # no such token
    assert torch.equal(loss(td)["loss_objective"], before)


def test_large_token_ids_are_not_rounded():
    ids = 2**24 + 1  # float32 has no such number
    actor, _ = make_actor()
    loss = loop(actor, ratio_level="token")
    td = decided(actor)
    td[keys.TOKENS] = torch.full((ROWS, C, A), ids)
    seen = []
    loss._distribution = lambda _: type(
        "Seen", (), {"log_prob": lambda _, tokens: seen.append(tokens) or tokens * 0.0}
    )()
    loss(td)
    assert seen[0].dtype == torch.int64 and seen[0].max() == ids


def test_loop_finds_the_rewarded_token():
    actor, logits = make_actor()
    optimizer, loss = torch.optim.Adam([logits], 0.1), loop(actor, ratio_level="token", clip_epsilon=0.2)
    torch.manual_seed(2)
    for _ in range(60):
        waves = torch.stack([rows()] * 8, 1)  # [6 contexts, 8 rollouts]
        with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
            td = actor(waves)
        returns = (td[keys.TOKENS] == 3).float().mean((-2, -1))
        td[keys.ADVANTAGE] = rloo_advantage(returns)[..., None]
        td[keys.STEP_MASK] = torch.ones(ROWS, 8, C, dtype=torch.bool)
        optimizer.zero_grad()
        loss(td)["loss_objective"].backward()
        optimizer.step()
    assert logits.softmax(-1)[..., 3].mean() > 3 / V


def test_torchrls_own_token_policies_act_and_learn():
    torch.manual_seed(0)
    tiny = TinyVLA(
        action_dim=A, chunk_size=C, hidden_dim=16, action_head="tokens", vocab_size=V, action_tokenizer=TOKENIZER,
        logits_only=True,
    )  # fmt: skip
    key = tiny.out_keys[0]
    td = TensorDict(batch_size=[3])
    td[keys.IMAGE] = torch.randint(0, 256, (3, 3, 16, 16), dtype=torch.uint8)
    td[keys.STATE] = torch.randn(3, 7)
    td[keys.INSTRUCTION] = "open the drawer"
    actor = token_actor(tiny, TOKENIZER, logits_key=key)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        td = actor(td)
    assert td[keys.CHUNK].shape == (3, C, A)
    td[keys.ADVANTAGE] = torch.tensor([[1.0], [-1.0], [0.5]])
    td[keys.STEP_MASK] = torch.ones(3, C, dtype=torch.bool)
    out = loop(actor, ratio_level="token")(td)
    assert math.isclose(out["kl_approx"].item(), 0.0, abs_tol=1e-6)
    out["loss_objective"].backward()
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in tiny.parameters())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"temperature": 0.0}, "temperature must be positive, got 0.0; for greedy actions"),
        ({"logits_key": "scores"}, "no 'scores': name its logits in logits_key"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        make_actor(**settings)


def test_a_ratio_for_each_token_needs_a_log_prob_for_each():
    actor, _ = make_actor(event_dims=1)
    with pytest.raises(ValueError, match="ratio_level='token' needs log-probs"):
        loop(actor, ratio_level="token")(decided(actor))
