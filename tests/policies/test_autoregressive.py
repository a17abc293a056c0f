"""LOOP on tokens that are drawn one after the other, against its equations on a slow forward."""

from __future__ import annotations

import pytest
import torch
from hf_token_policies import BINS, CHUNK_LENGTH, VOCABULARY, token_policy
from observations import observed
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss, rloo_advantage
from worldenv_trl.policies import AutoregressiveActor, HFTokenPolicy, policy_actor

FIRST = VOCABULARY - BINS


def decided(actor: AutoregressiveActor) -> TensorDict:
    torch.manual_seed(1)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        td = actor(observed())
    td[keys.ADVANTAGE] = torch.tensor([1.0, -1.0, 0.5, -0.5, 2.0, -2.0])[:, None]
    td[keys.STEP_MASK] = torch.arange(CHUNK_LENGTH) < torch.tensor([2, 1, 2, 1, 2, 1])[:, None]
    return td


def loop(actor: AutoregressiveActor, **settings) -> LOOPLoss:
    loss = LOOPLoss(actor, **({"functional": False} | settings))
    loss.set_keys(action=keys.TOKENS)
    return loss


def slow_log_probs(policy: HFTokenPolicy, td: TensorDict, temperature: float) -> Tensor:
    """[n, C, 7]: each token by a forward of its own over one row's prompt and what was said before it."""
    _, (images, _, texts) = policy.observed(td)
    rows = []
    for row in range(len(td)):
        pixels = policy._pixels({name: image[row : row + 1] for name, image in images.items()})
        ids, valid = policy._prompt_tensors([texts[row]])
        said = td[keys.TOKENS][row].flatten()
        scores = []
        for place in range(len(said)):
            hidden = policy.backbone(pixels, ids[valid][None], valid[valid][None], said[None, : place + 1] + FIRST)
            logits = hidden[0, -1] @ policy.action_head.weight.T / temperature
            scores.append(logits[said[place]] - logits.logsumexp(-1))
        rows.append(torch.stack(scores).unflatten(0, td[keys.TOKENS].shape[1:]))
    return torch.stack(rows)


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("level", ["token", "step", "chunk"])
def test_loop_is_its_equations_token_by_token(level, functional):
    policy, clip = token_policy(), (0.2, 0.28)
    actor = AutoregressiveActor(policy, temperature=1.3, event_dims=0 if level == "token" else 1)
    td = decided(actor)
    before = slow_log_probs(policy, td, 1.3).detach()
    with torch.no_grad():  # an update later
        policy.action_head.weight.add_(0.1 * torch.randn(policy.action_head.weight.shape))
    out = loop(actor, clip_epsilon=clip, ratio_level=level, functional=functional)(td)
    difference, total, clipped = slow_log_probs(policy, td, 1.3) - before, 0.0, 0
    for row in range(len(td)):
        executed, advantage = int(td[keys.STEP_MASK][row].sum()), td[keys.ADVANTAGE][row, 0]
        for step in range(executed):
            mine = difference[row, :executed]
            groups = {"token": list(mine[step]), "step": [mine[step].sum()], "chunk": [mine.sum()]}[level]
            for each in groups:
                ratio = each.exp()
                total = total - torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.28) * advantage) / len(groups)
                clipped += (not 0.8 < ratio < 1.28) / len(groups)
    expected = total / td[keys.STEP_MASK].sum()
    torch.testing.assert_close(out["loss_objective"], expected, rtol=1e-4, atol=1e-5)
    learning = [policy.action_head.weight, *(each for name, each in policy.named_parameters() if "lora_B" in name)]
    ours, theirs = (torch.autograd.grad(value, learning) for value in (out["loss_objective"], expected))
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-3, atol=1e-5)
    assert ours[0].abs().sum() > 0 and clipped > 0


@pytest.mark.parametrize("level", ["token", "chunk"])
def test_ratios_begin_at_one(level):
    actor = AutoregressiveActor(token_policy(), event_dims=0 if level == "token" else 1)
    td = decided(actor)
    ratio = loop(actor, ratio_level=level).ratios(td)[keys.RATIO]
    torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=0, atol=1e-4)


def test_tokens_that_were_not_executed_never_reach_the_loss():
    actor = AutoregressiveActor(token_policy(), event_dims=0)
    td = decided(actor)
    loss = loop(actor, ratio_level="token")
    before = loss(td)["loss_objective"]
    td[keys.TOKENS] = torch.where(td[keys.STEP_MASK][..., None], td[keys.TOKENS], 10**6)  # no such token
    torch.testing.assert_close(loss(td)["loss_objective"], before)


def test_loop_finds_the_rewarded_token():
    policy = token_policy(chunk_length=1)
    groups = policy.post_training_parameters(2)
    actor = policy_actor(policy, event_dims=0)
    optimizer = torch.optim.Adam([{"params": groups["adapters"], "lr": 0.01}, {"params": groups["heads"], "lr": 0.03}])
    loss, contexts = loop(actor, ratio_level="token", clip_epsilon=0.2), torch.stack([observed()[:2]] * 8, 1)
    torch.manual_seed(2)
    wanted = []
    for _ in range(30):
        with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
            td = actor(contexts.clone())
        returns = (td[keys.TOKENS] == 3).float().mean((-2, -1))
        wanted.append(returns.mean().item())
        td[keys.ADVANTAGE] = rloo_advantage(returns)[..., None]
        td[keys.STEP_MASK] = torch.ones(2, 8, 1, dtype=torch.bool)
        optimizer.zero_grad()
        loss(td)["loss_objective"].backward()
        optimizer.step()
    assert sum(wanted[-5:]) / 5 > sum(wanted[:5]) / 5 + 0.2
