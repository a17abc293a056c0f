"""v-prediction with a terminal signal of zero, and DDIM, against their closed forms."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("diffusers")

from worldenv_trl.world_models.diffusion_process import TRAIN_STEPS, ddim, make_scheduler

torch.manual_seed(0)
CLEAN, NOISE = torch.randn(3, 2, 4, 5), torch.randn(3, 2, 4, 5)


def signal() -> torch.Tensor:
    """Closed form of the share of signal, sqrt(alpha-bar), float64 [T]: betas equally spaced in their roots, and the
    product's root shifted to end at 0 and scaled to begin where it did (Lin et al. 2024, algorithm 1)."""
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, TRAIN_STEPS, dtype=torch.float64) ** 2
    root = (1 - betas).cumprod(0).sqrt()
    return (root - root[-1]) * root[0] / (root[0] - root[-1])


def test_the_schedule_is_the_rescaled_one_and_ends_in_pure_noise():
    scheduler = make_scheduler()
    torch.testing.assert_close(scheduler.alphas_cumprod.double(), signal().square(), atol=2e-5, rtol=0)
    assert scheduler.alphas_cumprod[-1] == 0
    last = torch.full((3,), TRAIN_STEPS - 1)
    torch.testing.assert_close(scheduler.add_noise(CLEAN, NOISE, last), NOISE)
    torch.testing.assert_close(scheduler.get_velocity(CLEAN, NOISE, last), -CLEAN)  # v of pure noise is the clean one


@pytest.mark.parametrize("timestep", [0, 300, 700, 998])
def test_v_is_the_velocity_of_the_circle_between_clean_and_noise(timestep):
    scheduler, times = make_scheduler(), torch.full((3,), timestep)
    cos = signal()[timestep].item()
    sin = (1 - cos**2) ** 0.5
    noisy, v = scheduler.add_noise(CLEAN, NOISE, times), scheduler.get_velocity(CLEAN, NOISE, times)
    torch.testing.assert_close(noisy, cos * CLEAN + sin * NOISE, atol=3e-3, rtol=0)
    torch.testing.assert_close(v, cos * NOISE - sin * CLEAN, atol=3e-3, rtol=0)
    torch.testing.assert_close(cos * noisy - sin * v, CLEAN, atol=3e-3, rtol=0)
    torch.testing.assert_close(sin * noisy + cos * v, NOISE, atol=3e-3, rtol=0)


def true_v(x: torch.Tensor, timestep: int) -> torch.Tensor:
    """Of what CLEAN became: v = (cos x - x_0) / sin."""
    cos = make_scheduler().alphas_cumprod[timestep].sqrt()
    return (cos * x - CLEAN) / (1 - cos**2).sqrt()


@pytest.mark.parametrize("steps", [1, 2, 4, 10, 27, 50])
@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_with_the_true_v_ddim_finds_what_was_disturbed(steps, eta):
    generator = torch.Generator().manual_seed(1)
    out = ddim(make_scheduler(), true_v, NOISE, steps, eta, lambda _: torch.randn(NOISE.shape, generator=generator))
    torch.testing.assert_close(out, CLEAN, atol=2e-4, rtol=0)


def test_one_step_returns_what_pure_noise_says():
    out = ddim(make_scheduler(), lambda x, timestep: 2 * x + timestep, NOISE, 1)
    torch.testing.assert_close(out, -(2 * NOISE + TRAIN_STEPS - 1))


@pytest.mark.parametrize("steps", [3, 10, 40])
def test_between_steps_as_much_noise_is_added_as_eta_says(steps):
    """A network that sees nothing but noise (v = x sin, so x_0 = 0, scaled) keeps DDPM's variance near 1."""
    scheduler, generator, drawn = make_scheduler(), torch.Generator().manual_seed(1), []

    def draw(step):
        drawn.append(step)
        return torch.randn(1, 100_000, generator=generator)

    seen = []

    def predict(x, timestep):  # believes that all of x is noise: epsilon = x / sin, x_0 = 0
        alpha = scheduler.alphas_cumprod[timestep]
        seen.append((x.std() / (1 - alpha).sqrt()).item())
        return x * (alpha / (1 - alpha)).sqrt()

    ddim(scheduler, predict, torch.randn(1, 100_000, generator=generator), steps, 1.0, draw)
    assert drawn == list(range(1, steps))
    assert seen == pytest.approx([1.0] * steps, abs=0.02)
