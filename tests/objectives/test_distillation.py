"""Means that are kept where another policy has them."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.objectives import DistillationLoss
from worldenv_trl.objectives.distillation import away_from
from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor


def decisions(count=6):
    """Decisions that differ by their images, and an actor's means there."""
    torch.manual_seed(0)
    actor = laplace_actor(OFTPolicy(OFTConfig(instructions=("open the drawer",))))
    image = torch.randint(0, 255, (count, 3, 64, 64), dtype=torch.uint8)
    observation = {"image": image, "state": torch.randn(count, 7)}
    rows = TensorDict({"observation": observation, "language_instruction": "open the drawer"}, [count])
    with torch.no_grad():
        there = actor.get_dist(rows.copy())
    rows[keys.REFERENCE_LOC], rows[keys.REFERENCE_SCALE] = there.loc, there.scale
    return actor, rows


def test_away_is_in_units_of_the_references_scale_and_a_mean_over_dimensions():
    loc, scale = torch.zeros(1, 2, 7), torch.full((1, 2, 7), 0.5)
    mean = torch.zeros(1, 2, 7)
    mean[0, 1, :2] = torch.tensor([1.0, -2.0])
    torch.testing.assert_close(away_from(mean, loc, scale), torch.tensor([[0.0, (2 + 4) / 7]]))


def test_the_loss_is_the_mean_over_all_decisions():
    actor, rows = decisions()
    loss = DistillationLoss(actor)
    assert loss(rows)["loss_distillation"] == 0 and keys.CHUNK not in rows.keys(True)
    rows[keys.REFERENCE_LOC][2:] += 3 * rows[keys.REFERENCE_SCALE][2:]
    torch.testing.assert_close(loss(rows)["loss_distillation"], torch.tensor(3 * 4 / 6))
    assert set(loss.in_keys) - {keys.INSTRUCTION} <= set(rows.keys(True, True))


def test_what_is_seen_otherwise_is_answered_alike():
    actor, rows = decisions()
    rows["observation", "image"] = rows["observation", "image"].flip(-1)  # not as the reference saw it
    rows[keys.REFERENCE_SCALE] = rows[keys.REFERENCE_SCALE] / 10
    loss = DistillationLoss(actor)
    optimizer = torch.optim.Adam(actor.parameters(), lr=2e-4)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, 160)
    values = []
    for _ in range(160):
        values.append(loss(rows)["loss_distillation"])
        optimizer.zero_grad()
        values[-1].backward()
        optimizer.step()
        schedule.step()
    assert 0 < 2 * values[-1] < values[0]
