"""The aim's divergence against a slow one, and what it teaches."""

from __future__ import annotations

import math
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from tensordict import NonTensorStack, TensorDict
from torch import nn
from torchrl.objectives import BCLoss

from worldenv_trl import keys
from worldenv_trl.objectives import AimedCloning
from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor
from worldenv_trl.robot import WRIST, look_at

FRONT = look_at("agentview", (0.8, 0.1, 0.6), (0.0, 0.0, 0.1), 40.0)
SIDE = look_at("agentview", (0.1, 0.9, 0.5), (0.0, 0.0, 0.0), 50.0)
TEXTS = ("left", "right")
CAMERAS = {"agentview": {"left": FRONT, "right": SIDE}}


class Fixed(nn.Module):
    """A policy that aims where it is told to."""

    def __init__(self, **maps):
        super().__init__()
        self.maps = nn.ParameterDict(maps)

    @contextmanager
    def aiming(self):
        yield {name: each.flatten(1).log_softmax(-1).view_as(each) for name, each in self.maps.items()}


class Half(nn.Module):
    def forward(self, samples):
        return TensorDict({"loss_bc": torch.tensor(0.5)})


def samples_at(points, pad=None):
    rows, points = len(points), torch.tensor(points, dtype=torch.float32)
    pad = torch.zeros(rows, 8, dtype=torch.bool) if pad is None else pad
    out = TensorDict({keys.WAYPOINT: points, keys.ACTION_IS_PAD: pad}, [rows])
    return out.set(keys.INSTRUCTION, NonTensorStack(*[TEXTS[row % 2] for row in range(rows)]))


def slow(point, camera, maps, width):
    """KL(target, aim) in nats, cell by cell."""
    side = maps.shape[-1]
    x, y = camera.project(np.array(point), side)
    density = {
        (i, j): math.exp(-((j + 0.5 - x) ** 2 + (i + 0.5 - y) ** 2) / (2 * width**2))
        for i in range(side)
        for j in range(side)
    }
    aim = maps.double().exp()
    return sum(
        each / sum(density.values()) * math.log(each / sum(density.values()) / (aim[i, j] / aim.sum()).item())
        for (i, j), each in density.items()
        if each > 0
    )


@pytest.mark.parametrize("side", [8, 16])
def test_the_divergence_is_that_from_a_normal_density_around_the_place(side):
    torch.manual_seed(0)
    points = [(0.02, -0.03, 0.05), (0.0, 0.1, 0.0), (-0.1, 0.0, 0.2), (0.03, 0.02, 0.1)]
    maps = torch.randn(4, side, side)
    out = AimedCloning(Half(), Fixed(agentview=maps), CAMERAS, weight=2.0, width=0.8)(samples_at(points))
    rows = zip(points, (FRONT, SIDE) * 2, maps, strict=True)
    expected = sum(slow(point, camera, each, 0.8) for point, camera, each in rows) / 4
    assert out["loss_aim"].item() == pytest.approx(2 * expected, rel=1e-4) and out["loss_bc"].item() == 0.5


def test_places_outside_the_image_and_cameras_on_the_tool_teach_nothing():
    torch.manual_seed(0)
    inside, outside = (0.02, -0.03, 0.05), (0.0, 3.0, 0.0)
    policy = Fixed(agentview=torch.randn(2, 16, 16), wrist=torch.randn(2, 16, 16))
    cameras = CAMERAS | {"wrist": dict.fromkeys(TEXTS, WRIST)}
    loss = AimedCloning(Half(), policy, cameras, weight=1.0)
    loss(samples_at([inside, outside]))["loss_aim"].backward()
    gradient = policy.maps["agentview"].grad
    assert gradient[0].abs().max() > 0 and gradient[1].abs().max() == 0 and torch.isfinite(gradient).all()
    assert policy.maps["wrist"].grad is None


def test_shares_of_a_batch_weighted_by_their_actions_add_up_to_it():
    torch.manual_seed(0)
    points = [(0.02, -0.03, 0.05), (0.0, 0.1, 0.0), (-0.1, 0.0, 0.2), (0.03, 0.02, 0.1)]
    pad = torch.arange(8) >= torch.tensor([[8], [3], [5], [1]])
    maps, whole = torch.randn(4, 16, 16), samples_at(points, pad)

    def aim(rows):
        return AimedCloning(Half(), Fixed(agentview=maps[rows]), CAMERAS, weight=1.0)(whole[rows])["loss_aim"]

    parts = [slice(0, 2), slice(2, 4)]
    weights = [(~pad[rows]).sum() for rows in parts]
    together = sum(aim(rows) * weight for rows, weight in zip(parts, weights, strict=True)) / sum(weights)
    torch.testing.assert_close(together, aim(slice(0, 4)))


def shown(rows):
    """Images with one bright spot each, somewhere else each time, and chunks that go there; where they are (px)."""
    points = torch.cat([0.3 * torch.rand(rows, 2) - 0.15, torch.zeros(rows, 1)], 1)
    at = torch.tensor(FRONT.project(points.numpy(), 32), dtype=torch.float32)
    side = torch.arange(32) + 0.5
    square = (side - at[:, :1]).square()[:, None] + (side - at[:, 1:]).square()[:, :, None]
    images = (255 * torch.exp(-square / 4)).to(torch.uint8)[:, None].expand(-1, 3, -1, -1)
    out = TensorDict({keys.IMAGE: images, keys.STATE: torch.zeros(rows, 7), keys.WAYPOINT: points}, [rows])
    out[keys.CHUNK], out[keys.ACTION_IS_PAD] = torch.zeros(rows, 8, 7), torch.zeros(rows, 8, dtype=torch.bool)
    out[keys.CHUNK][..., :2] = points[:, None, :2]
    return out.set(keys.INSTRUCTION, NonTensorStack(*["left"] * rows)), at


def test_a_policy_learns_to_aim_at_what_it_is_shown_and_to_go_there():
    """On new images; its actions are right to a tenth of what they vary by, which needs the places beside the
    transformer: without them a seventh is left."""
    torch.manual_seed(0)
    policy = OFTPolicy(OFTConfig(instructions=("left",), image_size=32, dim=32, head_dim=32, depth=1))
    policy.action_range.fill_(0.15)
    cloning = BCLoss(laplace_actor(policy), loss_function="l1")
    cloning.set_keys(action=keys.CHUNK, pad_mask=keys.ACTION_IS_PAD)
    loss = AimedCloning(cloning, policy, {"agentview": {"left": FRONT}}, weight=0.5)
    optimizer = torch.optim.Adam(policy.parameters(), lr=3e-3)
    for _ in range(150):
        optimizer.zero_grad()
        loss(shown(32)[0]).sum(reduce=True).backward()
        optimizer.step()
    samples, at = shown(64)
    with torch.no_grad(), policy.aiming() as aims:
        loc = policy(samples.copy())[keys.LOC]
    best = aims["agentview"].flatten(1).argmax(-1)
    found = torch.stack([best % 8, best // 8], -1) * 4 + 2.0
    assert (found - at).norm(dim=-1).median() < 4  # px: one cell
    wrong = (loc - samples[keys.CHUNK])[..., :2].abs().mean()
    assert wrong < samples[keys.CHUNK][..., :2].abs().mean() / 11


def test_what_cannot_be_is_refused():
    with pytest.raises(TypeError, match=r"must have aiming\(\), as OFTPolicy has, Linear has not"):
        AimedCloning(Half(), nn.Linear(1, 1), CAMERAS, weight=1.0)
    with pytest.raises(ValueError, match="one camera at least must stand still to be aimed with, got wrist"):
        AimedCloning(Half(), Fixed(), {"wrist": dict.fromkeys(TEXTS, WRIST)}, weight=1.0)
    for settings in ({"weight": -1.0}, {"weight": 1.0, "width": 0.0}):
        with pytest.raises(ValueError, match="weight must be at least 0 and width positive"):
            AimedCloning(Half(), Fixed(), CAMERAS, **settings)
