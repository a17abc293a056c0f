"""What every policy promises, on the compact one and on one that shares nothing with it."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from flow_models import flow_policy
from hf_models import hf_policy
from observations import INSTRUCTIONS, TEXTS, observed, oft_policy
from swaps.mlp_policy import MLPConfig, MLPPolicy
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MultiStepActorWrapper
from torchrl.objectives import BCLoss

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss
from worldenv_trl.policies import laplace_actor, likelihood_actor, scale_bounds


def mlp_policy() -> MLPPolicy:
    torch.manual_seed(0)
    return MLPPolicy(MLPConfig(instructions=INSTRUCTIONS))


@pytest.fixture(params=[oft_policy, mlp_policy, hf_policy, flow_policy], ids=["oft", "mlp", "hf", "flow"])
def policy(request):
    return request.param()


def expert() -> TensorDict:
    generator = torch.Generator().manual_seed(2)
    td = observed()
    td[keys.CHUNK] = torch.rand(6, 8, 7, generator=generator) - 0.5
    td[keys.ACTION_IS_PAD] = torch.arange(8) >= torch.tensor([8, 8, 3, 5, 1, 8])[:, None]
    return td


def cloning(actor, **options) -> BCLoss:
    loss = BCLoss(actor, **options)
    loss.set_keys(action=keys.CHUNK, pad_mask=keys.ACTION_IS_PAD)
    return loss


def decisions(actor) -> TensorDict:
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        td = actor(observed())
    td[keys.ADVANTAGE] = torch.tensor([1.0, -1.0, 0.5, -0.5, 2.0, -2.0])[:, None]
    td[keys.STEP_MASK] = torch.arange(8) < torch.tensor([8, 3, 8, 8, 1, 8])[:, None]
    return td


def train(loss, td, name: str, parameters, steps: int = 40, learning_rate: float = 3e-3) -> tuple[float, float]:
    optimizer = torch.optim.Adam(parameters, learning_rate)
    values = []
    for _ in range(steps):
        optimizer.zero_grad()
        value = loss(td)[name]
        value.backward()
        optimizer.step()
        values.append(value.item())
    return values[0], values[-1]


def test_the_three_stages_of_training_each_lower_their_loss_and_touch_only_their_parameters(policy):
    td, scale = expert(), list(policy.scale_parameters())
    policy.fit_statistics(td[keys.STATE], td[keys.CHUNK])
    kept = [parameter.clone() for parameter in scale]
    first, last = train(cloning(laplace_actor(policy), loss_function="l1"), td, "loss_bc", policy.parameters())
    assert last < 0.9 * first
    assert all(torch.equal(now, before) for now, before in zip(scale, kept, strict=True))

    policy.requires_grad_(False)
    for parameter in scale:
        parameter.requires_grad_(True)
    loc = policy(observed())[keys.LOC]
    first, last = train(cloning(likelihood_actor(policy)), td, "loss_bc", scale)
    assert last < first - 1
    assert torch.equal(policy(observed())[keys.LOC], loc)

    groups = policy.post_training_parameters(rank=2)
    trained = {id(parameter) for group in groups.values() for parameter in group}
    assert trained == {id(parameter) for parameter in policy.parameters() if parameter.requires_grad}
    frozen = {name: p.clone() for name, p in policy.named_parameters() if not p.requires_grad}
    actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
    batch, loss = decisions(actor), LOOPLoss(actor, clip_epsilon=0.2, functional=False)
    assert loss(batch)["kl_approx"] < 1e-6  # the adapters change nothing yet
    updated = [p for p in policy.parameters() if p.requires_grad]
    # at 3e-3 ten steps go 3 to 12 nats away, and past the optimum, whatever the policy
    first, last = train(loss, batch, "loss_objective", updated, steps=10, learning_rate=3e-4)
    assert last < first / 2
    for name, parameter in policy.named_parameters():
        assert name not in frozen or torch.equal(parameter, frozen[name])


@pytest.mark.parametrize("functional", [True, False])
def test_a_loss_reads_texts_from_a_tensordict_and_from_keywords(policy, functional):
    actor = laplace_actor(policy)
    batch, loss = decisions(actor), LOOPLoss(actor, functional=functional)
    assert keys.INSTRUCTION in loss.in_keys
    entries = {"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss.in_keys}
    out = loss(**entries | {keys.INSTRUCTION: TEXTS})
    assert torch.equal(out[0], loss(batch)["loss_objective"])


def test_minibatches_of_decisions_with_different_texts_are_scored_as_the_whole_batch(policy):
    actor = laplace_actor(policy)
    batch = decisions(actor)
    whole = actor.get_dist(batch.copy()).log_prob(batch[keys.CHUNK])
    rows = torch.tensor([4, 0, 5])
    part = batch[rows]
    torch.testing.assert_close(actor.get_dist(part.copy()).log_prob(part[keys.CHUNK]), whole[rows])


def test_a_compiled_loss_gives_the_same_gradients_and_is_not_made_anew_for_other_texts():
    policy = oft_policy(depth=1)
    actor = laplace_actor(policy)
    loss = LOOPLoss(actor, functional=False)
    graphs = []

    def count(module, _):
        graphs.append(module)
        return module.forward

    compiled, made = torch.compile(loss, backend=count), None
    for texts in (TEXTS, TEXTS[::-1]):
        batch = decisions(actor).set(keys.INSTRUCTION, observed(texts=texts).get(keys.INSTRUCTION))
        values = [which(batch)["loss_objective"] for which in (loss, compiled)]
        gradients = [torch.autograd.grad(value, list(policy.scale_parameters())) for value in values]
        torch.testing.assert_close(values[0], values[1])
        torch.testing.assert_close(gradients[0], gradients[1])
        assert graphs and made in (None, len(graphs))
        made = len(graphs)


def test_chunks_are_played_one_action_a_step(policy):
    player = MultiStepActorWrapper(laplace_actor(policy), n_steps=8)
    td = player(observed().set("is_init", torch.ones(6, 1, dtype=torch.bool)))
    chunk = td[keys.CHUNK].clone()
    for step in range(1, 5):
        td["is_init"] = (torch.arange(6) == 2)[:, None] & (step == 4)  # row 2 begins again inside the others' chunk
        td = player(td)
        expected = chunk[:, step].clone()
        if step == 4:
            expected[2] = chunk[2, 0]
        torch.testing.assert_close(td[keys.ACTION], expected)


def test_a_saved_policy_reloads_to_equal_outputs(policy, tmp_path):
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 7))
    policy.post_training_parameters(rank=2)
    policy.save_pretrained(tmp_path)
    loaded = type(policy).from_pretrained(tmp_path)
    assert (loaded.cameras, loaded.instructions) == (policy.cameras, policy.instructions)
    assert torch.equal(loaded.action_range, policy.action_range)
    assert torch.equal(loaded(observed())[keys.LOC], policy(observed())[keys.LOC])


def test_a_copy_is_a_policy_of_its_own(policy):
    copy = deepcopy(policy)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter += 1
    assert not torch.equal(copy(observed())[keys.LOC], policy(observed())[keys.LOC])


def test_an_instruction_that_it_never_saw_is_answered_with_a_warning(policy):
    with pytest.warns(UserWarning, match="never trained on the instruction 'close the window'"):
        assert policy(observed(texts="close the window"))[keys.LOC].isfinite().all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda td: td.exclude(keys.IMAGE), r"has no \('observation', 'image'\) of 'agentview'"),
        (lambda td: td.set(keys.IMAGE, torch.zeros(6, 3, 64, 64)), r"uint8 \[6, 3, 64, 64\], got torch.float32"),
        (lambda td: td.set(keys.IMAGE, torch.zeros(6, 3, 32, 32, dtype=torch.uint8)), r"got torch.uint8 \[6, 3, 32"),
        (lambda td: td.set(keys.STATE, torch.zeros(6, 6)), r"\[\*B, 7\], got \[6, 6\]"),
        (lambda td: td.exclude(keys.INSTRUCTION), "holds no 'language_instruction'"),
    ],
)
def test_bad_input_is_named(policy, change, message):
    with pytest.raises(ValueError, match=message):
        policy(change(observed()))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cameras": ()}, "at least one camera"),
        ({"cameras": ("wrist", "wrist")}, "each once"),
        ({"proprio": "guessed"}, "got 'guessed'"),
        ({"chunk_length": 0}, "at least 1, got 64 and 0"),
    ],
)
def test_what_no_policy_can_be_trained_for_is_named(settings, message):
    with pytest.raises(ValueError, match=message):
        MLPPolicy(MLPConfig(instructions=INSTRUCTIONS, **settings))


@pytest.mark.parametrize(
    ("spoil", "got"),
    [
        (lambda loc, scale: (loc[:, :4], scale), r"\(6, 4, 7\), \(6, 8, 7\)"),
        (lambda loc, scale: (loc[..., :6], scale[..., :6]), r"\(6, 8, 6\), \(6, 8, 6\)"),
        (lambda loc, scale: loc, r"\(6, 8, 7\)$"),
        (lambda loc, scale: (loc, None), r"\(6, 8, 7\), NoneType"),
    ],
)
def test_predictions_of_another_shape_are_named(spoil, got):
    class Spoiled(MLPPolicy):
        def predict(self, *observed):
            return spoil(*super().predict(*observed))

    policy = Spoiled(MLPConfig(instructions=INSTRUCTIONS))
    with pytest.raises(
        ValueError, match=r"Spoiled.predict must give loc and log_scale, \(6, 8, 7\) each .* got " + got
    ):
        policy(observed())
