"""A vision-language policy on a GPU computes what it computes on the CPU."""

from __future__ import annotations

import copy

import pytest
import torch
from hf_models import FAMILIES, hf_policy
from observations import observed
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.devices import to_device
from worldenv_trl.objectives import LOOPLoss
from worldenv_trl.policies import laplace_actor, scale_bounds


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
