"""FlowPolicy: what it refuses, what learns, and what a step of LOOP does to it."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from flow_models import flow_policy
from observations import observed
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss
from worldenv_trl.policies import FlowConfig, laplace_actor, scale_bounds

KINDS = ("smolvla", "pi0", "pi05")


def decisions(actor):
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        td = actor(observed())
    td[keys.ADVANTAGE] = torch.tensor([1.0, -1.0, 0.5, -0.5, 2.0, -2.0])[:, None]
    td[keys.STEP_MASK] = torch.ones(6, 8, dtype=torch.bool)
    return td


@pytest.mark.parametrize("rank", [0, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_an_update_of_loop_makes_better_actions_likelier(kind, rank):
    policy = flow_policy(kind, lora_rank=rank, gradient_checkpointing=True).train()
    groups = policy.post_training_parameters(rank)
    actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
    batch, loss = decisions(actor), LOOPLoss(actor, functional=False)
    for group in groups.values():
        policy.zero_grad()
        before = loss(batch)["loss_objective"]
        before.backward()
        slope = torch.stack([each.grad.norm() for each in group if each.grad is not None]).norm()
        with torch.no_grad():
            for each in group:
                if each.grad is not None:
                    each -= 1e-4 / slope * each.grad
        after = loss(batch)["loss_objective"]
        assert slope > 0.1 and (before - after).item() == pytest.approx(1e-4 * slope.item(), rel=0.2)
    change = actor.get_dist(batch.copy()).log_prob(batch[keys.CHUNK]).sum(-1) - batch["vla_action", "log_probs"].sum(-1)
    assert (change * batch[keys.ADVANTAGE][:, 0]).mean() > 0


@pytest.mark.parametrize("kind", KINDS)
def test_the_scale_depends_on_what_is_seen_and_not_on_the_actions_units(kind):
    policy = flow_policy(kind)
    torch.nn.init.normal_(policy.scale_head.linear_out.weight)
    before = policy(observed())
    assert before[keys.LOG_SCALE].std(0).min() > 1e-4
    policy.action_gain *= 2
    after = policy(observed())
    assert torch.equal(after[keys.LOG_SCALE], before[keys.LOG_SCALE])
    torch.testing.assert_close(after[keys.LOC], 2 * before[keys.LOC])


@pytest.mark.parametrize("kind", KINDS)
def test_what_it_does_depends_on_images_text_and_proprioception(kind):
    policy, td = flow_policy(kind), observed()
    before = policy(td.copy())[keys.LOC]
    for key, value in ((keys.IMAGE, 255 - td[keys.IMAGE]), (keys.STATE, td[keys.STATE] + 0.3)):
        assert (policy(td.copy().set(key, value))[keys.LOC] - before).abs().amax((1, 2)).min() > 1e-6
    change = (policy(observed(texts="turn on the stove"))[keys.LOC] - before).abs().amax((1, 2))
    assert change[0] > 1e-3 > 1e-5 > change[2]  # the third was asked for this before


def test_actions_of_smolvla_see_those_before_them_alone():
    for kind, causal in (("smolvla", True), ("pi0", False)):
        policy = flow_policy(kind)
        before = policy(observed())[keys.LOC]
        policy.noise[5:] += 1
        change = (policy(observed())[keys.LOC] - before).abs().amax((0, 2))
        assert (change[5:] > 1e-4).all()
        assert causal == (change[:5].max() < 1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_more_steps_come_closer_to_where_the_flow_ends(kind):
    ends = {steps: flow_policy(kind, num_steps=steps)(observed())[keys.LOC] for steps in (1, 8, 64, 128)}
    errors = [(ends[steps] - ends[128]).abs().mean() for steps in (1, 8, 64)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2] > 0


def test_statistics_of_nothing_are_refused():
    policy = flow_policy()
    for states, actions, name in (
        (torch.zeros(0, 7), torch.zeros(3, 7), "states"),
        (torch.zeros(3, 7), torch.full((3, 7), torch.nan), "actions"),
    ):
        with pytest.raises(ValueError, match=f"{name} must hold at least one row and only finite numbers"):
            policy.fit_statistics(states, actions)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "act"}, "kind must be one of smolvla, pi0, pi05, got 'act'"),
        ({"kind": "pi0"}, "the backbone of pi0 must be a paligemma, got 'smolvlm'"),
        ({"chunk_length": 11}, "chunk_length must be at least 1 and at most 10.*got 11"),
        ({"num_steps": 0}, "num_steps and max_tokens must be at least 1, got 0, 200"),
        ({"max_action_dim": 6}, "max_action_dim must be at least 7 and max_state_dim 8, got 6 and 9"),
        ({"proprio_format": "joints"}, "proprio_format must be one of state, libero, got 'joints'"),
        ({"lora_alpha": -1}, "lora_rank and lora_alpha must not be negative, got 2, -1"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, message):
    config = flow_policy().config
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(config, **settings)


def test_a_config_is_read_again_as_it_was_written():
    config = flow_policy().config
    assert FlowConfig.from_dict(dataclasses.asdict(config)) == config


def test_tokens_around_images_must_be_the_tokenizers():
    from tokenizers import Tokenizer, models

    from worldenv_trl.policies import FlowPolicy

    config = dataclasses.replace(flow_policy().config, image_tokens=True)
    with pytest.raises(ValueError, match="no token '<fake_token_around_image>': take the tokenizer of this backbone"):
        FlowPolicy(config, Tokenizer(models.WordLevel({"<unk>": 0}, unk_token="<unk>")))


def test_an_expert_of_a_number_of_layers_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="3 layers of an expert cannot stand beside 2 of a language model"):
        flow_policy(expert_layers=3)
