"""LOOPLoss against plain Python loops over World-Env Eq. 4-5."""

from __future__ import annotations

import math

import pytest
import torch
from loop_batches import LENGTHS, A, C, G, N, T, assert_same, make_actor, make_batch, value_and_gradient
from torch.testing import assert_close
from torchrl.objectives import ClipPPOLoss

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss


def reference(actor, batch, *, level="step", normalize="global", low=0.1, high=0.1) -> torch.Tensor:
    """Eq. 4-5 as sums over groups, rollouts and executed steps, with the Laplace density written out."""
    heads = actor.module[0].module
    total = sum(map(sum, LENGTHS))
    bounds = torch.tensor([1 - low, 1 + high], dtype=torch.float64)
    objective = torch.zeros((), dtype=torch.float64)
    for g in range(G):
        for n in range(N):
            returns = batch["returns"][g, :, 0]
            advantage = returns[n] - sum(returns[m] for m in range(N) if m != n) / (N - 1)
            for t in range(LENGTHS[g][n]):
                decision, step = divmod(t, C)
                entry = batch[g, n, decision]
                loc, scale = heads(entry["features"])

                def log_ratio(c, entry=entry, loc=loc, scale=scale):
                    density = -(entry[keys.CHUNK][c] - loc[c]).abs() / scale[c] - torch.log(2 * scale[c])
                    before = entry[keys.LOG_PROBS][c]
                    return density - before if before.ndim else density.sum() - before

                def shift_log_ratio(entry=entry, loc=loc, scale=scale):
                    b = scale.mean(0) / math.sqrt(C)
                    density = -(entry[keys.CHUNK] - loc).mean(0).abs() / b - torch.log(2 * b)
                    return density.sum() - entry[keys.LOG_PROBS][0]

                if level == "shift":
                    ratios = [shift_log_ratio().exp()]
                elif level == "chunk":
                    executed = min(C, LENGTHS[g][n] - decision * C)
                    ratios = [torch.exp(sum(log_ratio(c) for c in range(executed)))]
                elif level == "dim":
                    ratios = list(log_ratio(step).exp())
                else:
                    ratios = [log_ratio(step).sum().exp()]
                gain = 0.0
                for ratio in ratios:
                    clipped = min(max(ratio, bounds[0]), bounds[1])
                    gain = gain + min(ratio * advantage, clipped * advantage) / len(ratios)
                objective = objective + gain / (total if normalize == "global" else LENGTHS[g][n] * G * N)
    return -objective


def slow(actor, batch, **kwargs):
    return value_and_gradient(actor, lambda td: {"loss_objective": reference(actor, td, **kwargs)}, batch)


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("level", ["step", "chunk", "dim"])
@pytest.mark.parametrize("normalize", ["global", "episode"])
@pytest.mark.parametrize("clip", [0.1, (0.2, 0.05)])
def test_value_and_gradient_equal_the_equations(functional, level, normalize, clip):
    event_dims = 0 if level == "dim" else 1
    actor, batch = make_actor(event_dims), make_batch(event_dims)
    loss = LOOPLoss(actor, clip_epsilon=clip, ratio_level=level, normalize=normalize, functional=functional)
    low, high = clip if isinstance(clip, tuple) else (clip, clip)
    expected = slow(actor, batch, level=level, normalize=normalize, low=low, high=high)
    assert max(gradient.abs().max() for gradient in expected[1]) > 1e-3
    assert_same(value_and_gradient(actor, loss, batch), expected)


@pytest.mark.parametrize("functional", [True, False])
def test_where_a_chunk_is_displaced_as_a_whole_each_executed_step_has_its_ratio(functional):
    actor, batch = make_actor(noise="chunk"), make_batch(noise="chunk")
    loss = LOOPLoss(actor, functional=functional)
    expected = slow(actor, batch, level="shift")
    assert max(gradient.abs().max() for gradient in expected[1]) > 1e-3
    assert_same(value_and_gradient(actor, loss, batch), expected)
    batch[keys.CHUNK][~batch[keys.MASK]] = math.nan
    assert_same(value_and_gradient(actor, loss, batch), expected)


def test_a_chunk_that_is_displaced_as_a_whole_has_one_ratio_already():
    loss = LOOPLoss(make_actor(noise="chunk"), ratio_level="chunk")
    with pytest.raises(ValueError, match='ChunkLaplace has that of the chunk at every step, use "step"'):
        loss(make_batch(noise="chunk"))


@pytest.mark.parametrize("events", [0, 1])
def test_steps_that_were_sampled_one_by_one_are_not_scored_as_a_whole_chunk(events):
    batch = make_batch(events, noise="chunk")
    batch[keys.LOG_PROBS][~batch[keys.MASK]] = math.nan  # nobody's
    LOOPLoss(make_actor(events, noise="chunk"))(batch)
    with pytest.raises(ValueError, match="differ from step to step, those of ChunkLaplace do not: collect and train"):
        LOOPLoss(make_actor(events, noise="chunk"))(make_batch(events))


def test_per_dimension_log_probs_also_serve_step_ratios():
    actor, batch = make_actor(0), make_batch(0)
    assert_same(value_and_gradient(actor, LOOPLoss(actor), batch), slow(actor, batch))


def test_the_example_has_ratios_on_both_sides_of_the_clip_for_both_signs_of_the_advantage():
    batch = make_batch()
    with torch.no_grad():
        now = make_actor().get_dist(batch.clone()).log_prob(batch[keys.CHUNK])
    steps = batch["next", keys.STEP_MASK]
    ratio = (now - batch[keys.LOG_PROBS]).exp()
    good = (batch[keys.ADVANTAGE] > 0).expand_as(steps)
    for sign in (good, ~good):
        for side in (ratio < 0.9, ratio > 1.1, (ratio > 0.9) & (ratio < 1.1)):
            assert (side & sign & steps).any()


@pytest.mark.parametrize("normalize", ["global", "episode"])
@pytest.mark.parametrize("size", [1, 4, 7])
def test_minibatches_add_up_to_the_whole_batch(normalize, size):
    actor, batch = make_actor(), make_batch()
    loss = LOOPLoss(actor, normalize=normalize)
    whole = value_and_gradient(actor, loss, batch)
    steps = batch["next", keys.STEP_MASK]
    total = steps.sum((-2, -1))[..., None, None] if normalize == "episode" else steps.sum()
    batch["total_steps"] = total.expand(G, N, T, 1).clone()
    batch["num_rollouts"] = torch.full((G, N, T, 1), G * N)
    rows = batch[batch[keys.MASK]]
    shuffled = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(2))]
    assert_same(value_and_gradient(actor, loss, *shuffled.split(size)), whole)


def test_without_a_total_the_steps_at_hand_are_counted():
    actor, batch = make_actor(), make_batch()
    rows, loss = batch[batch[keys.MASK]], LOOPLoss(actor)
    counts = [int(part["next", keys.STEP_MASK].sum()) for part in rows.split(4)]
    parts = [loss(part)["loss_objective"].item() * count for part, count in zip(rows.split(4), counts, strict=True)]
    assert_close(sum(parts) / sum(counts), loss(batch)["loss_objective"].item(), rtol=0, atol=1e-12)


def test_the_first_update_is_the_plain_policy_gradient():
    actor, batch = make_actor(), make_batch(spread=0.0)
    value, gradient = value_and_gradient(actor, LOOPLoss(actor), batch)
    steps, advantage = batch["next", keys.STEP_MASK], batch[keys.ADVANTAGE]
    assert_close(value, (-(advantage * steps).sum() / steps.sum()).item())
    actor.zero_grad()
    log_prob = actor.get_dist(batch.clone()).log_prob(batch[keys.CHUNK])
    (-(log_prob * advantage * steps).sum() / steps.sum()).backward()
    for one, parameter in zip(gradient, actor.parameters(), strict=True):
        assert_close(one, parameter.grad, rtol=0, atol=1e-12)


@pytest.mark.parametrize("trash", [math.nan, math.inf, 1e6])
def test_what_was_not_executed_reaches_neither_value_nor_gradient(trash):
    actor, batch = make_actor(), make_batch()
    loss = LOOPLoss(actor)
    clean = value_and_gradient(actor, loss, batch)
    skipped = ~batch["next", keys.STEP_MASK]
    batch[keys.CHUNK][skipped] = trash
    batch[keys.LOG_PROBS][skipped] = trash
    batch[keys.ADVANTAGE][~batch[keys.MASK]] = trash
    assert_same(value_and_gradient(actor, loss, batch), clean)
    assert all(value.isfinite() for value in loss(batch).values())


def test_decisions_outside_the_collector_mask_do_not_count_whatever_their_step_mask():
    actor, batch = make_actor(), make_batch()
    loss = LOOPLoss(actor)
    clean = value_and_gradient(actor, loss, batch)
    batch["next", keys.STEP_MASK][~batch[keys.MASK]] = True
    assert_same(value_and_gradient(actor, loss, batch), clean)


def test_a_step_mask_at_the_root_serves_decisions_without_next():
    actor, batch = make_actor(), make_batch()
    flat = batch.exclude(keys.STEP_MASK, "next").set(keys.STEP_MASK, batch["next", keys.STEP_MASK])
    loss = LOOPLoss(actor)
    assert_same(value_and_gradient(actor, loss, flat), value_and_gradient(actor, loss, batch))


def test_a_ratio_that_overflows_does_no_harm_where_the_advantage_is_zero():
    actor, batch = make_actor(), make_batch()
    batch[keys.ADVANTAGE][0] = 0.0
    loss = LOOPLoss(actor)
    clean = value_and_gradient(actor, loss, batch)
    batch[keys.LOG_PROBS][0] -= 1e4
    assert_same(value_and_gradient(actor, loss, batch), clean)


def test_a_batch_in_which_nothing_was_executed_gives_zero():
    actor, batch = make_actor(), make_batch()
    batch["next", keys.STEP_MASK].zero_()
    for normalize in ("global", "episode"):
        value, gradient = value_and_gradient(actor, LOOPLoss(actor, normalize=normalize), batch)
        assert value == 0 and not any(one.any() for one in gradient)


def test_torchrls_clipped_loss_agrees_where_both_are_defined():
    """One ratio per decision of one step: ClipPPOLoss's own setting."""
    actor, batch = make_actor(2), make_batch()
    rows = batch[batch[keys.MASK]]
    rows["next", keys.STEP_MASK].fill_(True)
    with torch.no_grad():
        now = actor.get_dist(rows.clone()).log_prob(rows[keys.CHUNK])  # [M]
    shift = 0.2 * torch.randn(now.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    stock = ClipPPOLoss(actor, clip_epsilon=0.1, entropy_bonus=False).double()
    stock.set_keys(action=keys.CHUNK, sample_log_prob=keys.LOG_PROBS, advantage=keys.ADVANTAGE)
    expected = value_and_gradient(actor, stock, rows.clone().set(keys.LOG_PROBS, now + shift))

    per_step = make_actor(1)
    with torch.no_grad():
        each = per_step.get_dist(rows.clone()).log_prob(rows[keys.CHUNK])  # [M, C]
    ours = LOOPLoss(per_step, ratio_level="chunk")
    mine = value_and_gradient(per_step, ours, rows.clone().set(keys.LOG_PROBS, each + shift[:, None] / C))
    assert_close(mine[0], expected[0], rtol=1e-6, atol=1e-7)  # torchrl keeps its bounds in float32
    for one, other in zip(mine[1], expected[1], strict=True):
        assert_close(one, other, rtol=1e-6, atol=1e-7)


def test_diagnostics_cover_exactly_the_executed_steps():
    actor, batch = make_actor(), make_batch()
    out = LOOPLoss(actor)(batch)
    with torch.no_grad():
        now = actor.get_dist(batch.clone()).log_prob(batch[keys.CHUNK])
    log_ratio = (now - batch[keys.LOG_PROBS])[batch["next", keys.STEP_MASK]]
    ratio = log_ratio.exp()
    assert_close(out["kl_approx"], (ratio - 1 - log_ratio).mean())
    assert_close(out["clip_fraction"].item(), ((ratio - 1).abs() > 0.1).double().mean().item(), rtol=1e-6, atol=0)
    assert_close(out["ESS"], ratio.sum() ** 2 / (ratio**2).sum() / len(ratio))
    assert not any(out[key].requires_grad for key in ("kl_approx", "clip_fraction", "ESS"))


@pytest.mark.parametrize("level", ["step", "chunk"])
def test_ratios_of_a_log_are_those_whose_gradient_the_clip_takes_away(level):
    batch, actor = make_batch(), make_actor()
    loss = LOOPLoss(actor, clip_epsilon=(0.1, 0.2), ratio_level=level)
    out = loss.ratios(batch)
    assert set(batch.keys(True, True)) == set(make_batch().keys(True, True))
    with torch.no_grad():
        log_ratio = actor.get_dist(batch).log_prob(batch[keys.CHUNK]) - batch[keys.LOG_PROBS]
    steps = batch["next", keys.STEP_MASK]
    expected = torch.where(steps, log_ratio, 0.0)
    if level == "chunk":
        expected = torch.where(steps, expected.sum(-1, keepdim=True), 0.0)
    assert_close(out[keys.RATIO], expected.exp())
    assert out[keys.CLIPPED].any() and (steps & ~out[keys.CLIPPED]).any() and not out[keys.CLIPPED][~steps].any()
    # Behaviour probabilities get a gradient exactly where nothing is clipped.
    before = batch[keys.LOG_PROBS].clone().requires_grad_()
    ratio = torch.where(steps, actor.get_dist(batch).log_prob(batch[keys.CHUNK]).detach() - before, 0.0)
    ratio = (ratio.sum(-1, keepdim=True).expand_as(steps) if level == "chunk" else ratio).exp()
    advantage = batch[keys.ADVANTAGE]
    gain = torch.minimum(ratio * advantage, ratio.clamp(0.9, 1.2) * advantage)
    for step in steps.nonzero()[:20].tolist():
        (slope,) = torch.autograd.grad(gain[tuple(step)], before, retain_graph=True)
        assert (slope.abs().max() == 0) == bool(out[keys.CLIPPED][tuple(step)])


def test_the_input_is_left_as_it_was():
    actor, batch = make_actor(), make_batch()
    before = batch.clone()
    LOOPLoss(actor)(batch)
    assert set(batch.keys(True, True)) == set(before.keys(True, True))
    assert (batch == before).all()


def test_entries_may_carry_other_nested_names():
    actor, batch = make_actor(), make_batch()
    loss = LOOPLoss(actor)
    expected = value_and_gradient(actor, loss, batch)
    batch.rename_key_(keys.CHUNK, ("a", "b", "chunk"))
    batch.rename_key_(keys.LOG_PROBS, ("a", "log_probs"))
    batch.rename_key_(keys.ADVANTAGE, ("a", "advantage"))
    batch.rename_key_(("next", keys.STEP_MASK), ("a", "steps"))
    batch.rename_key_(keys.MASK, "valid")
    loss.set_keys(
        action=("a", "b", "chunk"),
        sample_log_prob=("a", "log_probs"),
        advantage=("a", "advantage"),
        step_mask=("a", "steps"),
        mask="valid",
    )
    assert_same(value_and_gradient(actor, loss, batch), expected)
    assert ("a", "steps") in loss.in_keys
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(value="state_value")


def test_keywords_work_in_place_of_a_tensordict():
    actor, batch = make_actor(), make_batch()
    rows = batch[batch[keys.MASK]]
    loss = LOOPLoss(actor)
    out = loss(
        features=rows["features"],
        vla_action_chunk=rows[keys.CHUNK],
        vla_action_log_probs=rows[keys.LOG_PROBS],
        advantage=rows[keys.ADVANTAGE],
        step_mask=rows["next", keys.STEP_MASK],
    )
    assert_close(out[0], loss(rows)["loss_objective"])


def test_the_clip_can_be_scheduled():
    actor, batch = make_actor(), make_batch()
    loss = LOOPLoss(actor)
    loss.clip_epsilon = 0.3
    assert_same(value_and_gradient(actor, loss, batch), slow(actor, batch, low=0.3, high=0.3))
    loss.clip_epsilon = (0.05, 0.2)
    assert loss.clip_epsilon == (0.05, 0.2)
    with pytest.raises(ValueError, match="clip_epsilon"):
        loss.clip_epsilon = -0.1


@pytest.mark.parametrize("functional", [True, False])
def test_frozen_parameters_stay_frozen_and_an_optimizer_step_reaches_the_actor(functional):
    actor, batch = make_actor(), make_batch()
    heads = actor.module[0].module
    heads.loc.requires_grad_(False)
    loss = LOOPLoss(actor, functional=functional)
    assert loss.functional is functional
    before = {name: value.clone() for name, value in heads.state_dict().items()}
    optimizer = torch.optim.SGD([p for p in loss.parameters() if p.requires_grad], lr=0.1)
    loss(batch)["loss_objective"].backward()
    optimizer.step()
    after = heads.state_dict()
    assert torch.equal(after["loc.weight"], before["loc.weight"])
    assert not torch.equal(after["beta.weight"], before["beta.weight"])


@pytest.mark.parametrize("functional", [True, False])
def test_adapters_injected_by_peft_are_trained(functional):
    peft = pytest.importorskip("peft")
    actor, batch = make_actor(), make_batch()
    peft.inject_adapter_in_model(peft.LoraConfig(r=2, target_modules=["loc"]), actor.module[0].module)
    LOOPLoss(actor, functional=functional)(batch)["loss_objective"].backward()
    touched = {name for name, p in actor.named_parameters() if p.grad is not None and p.grad.any()}
    assert touched and all("lora_B" in name for name in touched)  # B starts at zero, so A has no gradient yet


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({keys.ADVANTAGE: torch.zeros(G, N, T)}, "advantage must be"),
        ({("next", keys.STEP_MASK): torch.ones(G, N, T, 1, dtype=torch.bool)}, "step_mask must be"),
        ({keys.LOG_PROBS: torch.zeros(G, N, T, C, A)}, "same event_dims"),
        ({keys.LOG_PROBS: torch.zeros(G, N, T, C, requires_grad=True)}, "no_grad"),
    ],
)
def test_entries_that_do_not_fit_are_named(change, message):
    batch = make_batch()
    for key, value in change.items():
        batch[key] = value
    with pytest.raises(ValueError, match=message):
        LOOPLoss(make_actor())(batch)


def test_settings_that_cannot_work_are_named():
    for kwargs in (
        {"clip_epsilon": 0.0},
        {"clip_epsilon": (1.0, 0.1)},
        {"clip_epsilon": (0.1,) * 3},
        {"ratio_level": "x"},
        {"normalize": "x"},
    ):
        with pytest.raises(ValueError, match=next(iter(kwargs))):
            LOOPLoss(make_actor(), **kwargs)
    with pytest.raises(ValueError, match="event_dims=0"):
        LOOPLoss(make_actor(), ratio_level="dim")(make_batch())
    with pytest.raises(ValueError, match="actor of tokens"):
        LOOPLoss(make_actor(), ratio_level="token")(make_batch())
    with pytest.raises(ValueError, match="event_dims=1"):
        rows = make_batch()
        rows[keys.LOG_PROBS] = rows[keys.LOG_PROBS].sum(-1)
        LOOPLoss(make_actor(2))(rows)
    with pytest.raises(ValueError, match="total_steps"):
        batch = make_batch()
        LOOPLoss(make_actor(), normalize="episode")(batch[batch[keys.MASK]])
