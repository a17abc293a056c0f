"""What LOOPLoss asks of decisions that are held, against plain Python loops."""

from __future__ import annotations

import math

import pytest
import torch
from loop_batches import LENGTHS, A, C, G, N, T, assert_same, make_actor, make_batch, value_and_gradient

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("normalize", ["global", "episode"])
def test_what_is_held_costs_its_distance_in_units_of_the_references_scale(functional, normalize):
    actor, batch = make_actor(), make_batch()
    loss = LOOPLoss(actor, reference_coef=3.0, normalize=normalize, functional=functional)
    free = value_and_gradient(actor, LOOPLoss(actor, normalize=normalize, functional=functional), batch)
    generator = torch.Generator().manual_seed(3)
    held = torch.rand(G, N, T, 1, generator=generator) < 0.5
    batch[keys.HELD] = held
    batch[keys.REFERENCE_LOC] = torch.randn(G, N, T, C, A, generator=generator, dtype=torch.float64)
    batch[keys.REFERENCE_SCALE] = torch.rand(G, N, T, C, A, generator=generator, dtype=torch.float64) + 0.1

    def written_out(td):
        total, heads = torch.zeros((), dtype=torch.float64), actor.module[0].module
        for g in range(G):
            for n in range(N):
                for t in range(LENGTHS[g][n]):
                    entry = td[g, n, t // C]
                    if entry[keys.HELD]:
                        away = (heads(entry["features"])[0] - entry[keys.REFERENCE_LOC]).abs()
                        away = (away / entry[keys.REFERENCE_SCALE])[t % C].sum() / A
                        steps = sum(map(sum, LENGTHS)) if normalize == "global" else LENGTHS[g][n] * G * N
                        total = total + 3 * away / steps
        return {"loss_objective": total}

    expected = value_and_gradient(actor, written_out, batch)
    assert expected[0] > 0.1
    assert_same(value_and_gradient(actor, lambda td: {"loss_objective": loss(td)["loss_reference"]}, batch), expected)
    assert_same(value_and_gradient(actor, loss, batch), free)
    assert set(loss(batch).keys()) == set(loss.out_keys) and "loss_reference" in loss.out_keys


def test_a_reference_that_lacks_is_named():
    loss, batch = LOOPLoss(make_actor(), reference_coef=1.0), make_batch()
    with pytest.raises(ValueError, match=r"reference_coef needs 'held' \[2, 3, 3, 1\]"):
        loss(batch)
    for value in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="reference_coef must be at least 0"):
            LOOPLoss(make_actor(), reference_coef=value)
