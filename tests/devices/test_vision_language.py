"""A vision-language policy on a GPU computes what it computes on the CPU."""

from __future__ import annotations

import copy

import pytest
import torch
from hf_models import FAMILIES, hf_policy
from hf_token_policies import token_policy
from observations import observed
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl import keys
from worldenv_trl.devices import to_device
from worldenv_trl.objectives import LOOPLoss
from worldenv_trl.policies import TeacherForcing, laplace_actor, policy_actor, scale_bounds, token_cross_entropy


def near(there: torch.Tensor, here: torch.Tensor) -> None:
    assert there.device.type == "cuda", "the result was left on the CPU"
    torch.testing.assert_close(there.detach().cpu().float(), here.detach().float(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_decision(gpu, family):
    policy, td = hf_policy(family), observed()
    here = policy(td.clone())
    there = copy.deepcopy(policy).to(gpu)(to_device(td.clone(), gpu))
    for key in (keys.LOC, keys.LOG_SCALE):
        near(there[key], here[key])


def test_an_update(gpu):
    gradients = []
    for device in (torch.device("cpu"), gpu):
        policy = hf_policy("smolvlm").to(device)
        policy.post_training_parameters(2)
        actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
        td: TensorDict = observed()
        generator = torch.Generator().manual_seed(2)
        td[keys.CHUNK] = torch.rand(6, 8, 7, generator=generator) - 0.5
        td = to_device(td, device)
        with torch.no_grad():
            td[keys.LOG_PROBS] = actor.get_dist(td.copy()).log_prob(td[keys.CHUNK])
        td[keys.ADVANTAGE] = torch.linspace(-1, 1, 6, device=device)[:, None]
        td[keys.STEP_MASK] = torch.ones(6, 8, dtype=torch.bool, device=device)
        LOOPLoss(actor, functional=False)(td)["loss_objective"].backward()
        gradients.append({name: p.grad for name, p in policy.named_parameters() if p.grad is not None})
    here, there = gradients
    assert here.keys() == there.keys() and len(here) > 40
    for name, gradient in here.items():
        near(there[name], gradient)


@pytest.mark.parametrize("family", ["smolvlm", "prismatic", "qwen2_vl"])
def test_a_decision_by_tokens(gpu, family):
    policy, td = token_policy(family, prompt="{instruction} : {state} ?"), observed()
    there = copy.deepcopy(policy).to(gpu)
    acted, moved = policy_actor(policy)(td.clone()), policy_actor(there)(to_device(td.clone(), gpu))
    assert moved[keys.TOKENS].device.type == "cuda"
    assert torch.equal(moved[keys.TOKENS].cpu(), acted[keys.TOKENS])
    for key in (keys.CHUNK, keys.LOG_PROBS):
        near(moved[key], acted[key])
    with set_exploration_type(ExplorationType.RANDOM):
        drawn = policy_actor(there)(to_device(td.clone(), gpu))
    near(drawn[keys.LOG_PROBS], policy_actor(there).get_dist(drawn).log_prob(drawn[keys.TOKENS]).cpu())


def test_updates_of_tokens(gpu):
    gradients = []
    for device in (torch.device("cpu"), gpu):
        policy = token_policy().to(device)
        policy.post_training_parameters(2)
        actor, td = policy_actor(policy, event_dims=0), to_device(observed(), device)
        generator = torch.Generator().manual_seed(2)
        actions = torch.rand(6, policy.chunk_length, 7, generator=generator) - 0.5
        td[keys.TOKENS] = policy.action_tokenizer.encode(actions.to(device))
        with torch.no_grad():
            td[keys.LOG_PROBS] = actor.get_dist(td.copy()).log_prob(td[keys.TOKENS])
        td[keys.ADVANTAGE] = torch.linspace(-1, 1, 6, device=device)[:, None]
        td[keys.STEP_MASK] = torch.ones(6, policy.chunk_length, dtype=torch.bool, device=device)
        loss = LOOPLoss(actor, ratio_level="token", functional=False)
        loss.set_keys(action=keys.TOKENS)
        loss(td)["loss_objective"].backward()
        logits = TeacherForcing(policy)(td.copy())[keys.TOKENS]
        token_cross_entropy(logits, td[keys.TOKENS]).mean().backward()
        gradients.append({name: p.grad for name, p in policy.named_parameters() if p.grad is not None})
    here, there = gradients
    assert here.keys() == there.keys() and len(here) > 40
    for name, gradient in here.items():
        near(there[name], gradient)
