"""Consistency training: its closed forms, and what one step then paints where v-prediction paints the mean."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("diffusers")

from worldenv_trl.world_models.diffusion_process import ddim, make_scheduler
from worldenv_trl.world_models.diffusion_training import consistency_errors, v_errors

SHAPE = (1, 1, 1, 2)  # [C, z, h, w] of a row


def toy(steps: int | None) -> SimpleNamespace:
    return SimpleNamespace(scheduler=make_scheduler(), config=SimpleNamespace(consistency_steps=steps))


def test_a_network_that_knows_the_clean_end_makes_no_error():
    model, clean = toy(8), torch.randn(64, *SHAPE)

    def predict(noisy, timesteps):
        alpha = model.scheduler.alphas_cumprod[timesteps].view(-1, 1, 1, 1, 1)
        return (alpha.sqrt() * noisy - clean) / (1 - alpha).sqrt()

    error, latent = consistency_errors(model, predict, clean)
    torch.testing.assert_close(error, torch.zeros_like(error), atol=1e-3, rtol=0)
    torch.testing.assert_close(latent, torch.zeros_like(latent), atol=1e-3, rtol=0)


def test_each_jump_is_held_to_the_next_ones_and_the_last_to_the_clean_end():
    """A network whose jump lands on a number of its timestep's own: the errors are those numbers' differences."""
    model, clean, seen = toy(4), torch.full((256, *SHAPE), 50.0), []

    def predict(noisy, timesteps):
        seen.append(timesteps)
        alpha = model.scheduler.alphas_cumprod[timesteps].view(-1, 1, 1, 1, 1)
        wanted = timesteps.view(-1, 1, 1, 1, 1) / 10.0  # where the jump lands: 99.9, 74.9, 49.9, 24.9
        return (alpha.sqrt() * noisy - wanted) / (1 - alpha).sqrt()

    error, latent = consistency_errors(model, predict, clean)
    here, there = seen
    assert here.unique().tolist() == [249, 499, 749, 999]
    expected = torch.where(here == 249, 24.9 - 50.0, 25.0)
    torch.testing.assert_close(error[:, 0, 0, 0, 0], expected, atol=0.05, rtol=0)
    torch.testing.assert_close(latent[:, 0, 0, 0, 0], here / 10 - 50, atol=0.05, rtol=0)
    assert (there[here > 249] == here[here > 249] - 250).all()


class Network(torch.nn.Module):
    """v of pairs of numbers by a small network, told the level of noise."""

    def __init__(self, scheduler):
        super().__init__()
        self.alphas = scheduler.alphas_cumprod
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(4, 64), torch.nn.SiLU(), torch.nn.Linear(64, 64), torch.nn.SiLU(), torch.nn.Linear(64, 2)
        )

    def forward(self, noisy, timesteps):
        alpha = self.alphas[timesteps].unsqueeze(-1)
        told = torch.cat([noisy.flatten(1), alpha.sqrt(), (1 - alpha).sqrt()], 1)
        return self.layers(told).reshape(noisy.shape)


@pytest.mark.parametrize("steps", [None, 16])
def test_one_step_chooses_where_v_prediction_paints_the_mean(steps):
    """Clean are (1, 1) and (-1, -1), as often: the mean is 0, which is neither."""
    torch.manual_seed(0)
    model = toy(steps)
    network = Network(model.scheduler)
    optimizer = torch.optim.Adam(network.parameters(), lr=2e-3)
    for _ in range(1200):
        clean = (torch.randint(2, (256, 1, 1, 1, 1)) * 2.0 - 1).expand(256, *SHAPE)
        error, _ = (v_errors if steps is None else consistency_errors)(model, network, clean)
        optimizer.zero_grad()
        error.square().mean().backward()
        optimizer.step()
    with torch.no_grad():
        noise = torch.randn(512, *SHAPE)
        painted = ddim(model.scheduler, lambda x, t: network(x, torch.full((512,), t)), noise, 1)
    size = painted.abs().mean().item()
    if steps is None:
        assert size < 0.15
    else:
        assert size > 0.6 and (painted.mean()).abs() < 0.25  # both are chosen
