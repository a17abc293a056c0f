from __future__ import annotations

import pytest
import torch

from worldenv_trl.world_models.flow_matching import add_noise, counted_noise, sample, seeded_noise


def test_noise_levels_interpolate_from_noise_to_data():
    clean, noise = torch.randn(3, 2, 4), torch.randn(3, 2, 4)
    mixed = add_noise(clean, noise, torch.tensor([0.0, 0.25, 1.0]))
    assert torch.equal(mixed[0], noise[0])
    assert torch.allclose(mixed[1], 0.25 * clean[1] + 0.75 * noise[1])
    assert torch.equal(mixed[2], clean[2])


@pytest.mark.parametrize("steps", [1, 2, 3, 4])
def test_a_perfect_prediction_is_returned_whatever_the_number_of_steps(steps):
    clean = torch.randn(2, 5)
    levels = []

    def predict(x, level):
        levels.append(level[0].item())
        return clean

    assert torch.allclose(sample(predict, torch.randn(2, 5), steps), clean, atol=1e-6)
    assert levels == pytest.approx([step / steps for step in range(steps)])


def test_gaussian_data_is_sampled_with_its_spread_by_many_steps():
    """For x_0 ~ N(0, s^2) the exact x-prediction is linear; Euler steps of the flow must recover s."""
    spread = 0.5

    def predict(x, level):
        level = level.view(-1, 1)
        return x * level * spread**2 / (level**2 * spread**2 + (1 - level) ** 2)

    drawn = sample(predict, torch.randn(4000, 1, generator=torch.Generator().manual_seed(0)), 200)
    assert drawn.std().item() == pytest.approx(spread, rel=0.05)


def test_seeded_noise_is_a_function_of_the_row_seed():
    noise = seeded_noise(torch.tensor([[5], [6], [5]]), (2, 3))
    assert torch.equal(noise[0], noise[2]) and not torch.equal(noise[0], noise[1])


def test_counted_noise_is_standard_normal():
    noise = counted_noise(torch.arange(64).unsqueeze(-1) * 7919, (3, 50, 50)).double()
    assert noise.shape == (64, 3, 50, 50) and noise.isfinite().all()
    count = noise.numel()
    moments = [noise.pow(power).mean() for power in (1, 2, 3, 4)]
    for moment, expected, spread in zip(moments, (0, 1, 0, 3), (1, 2, 15, 96), strict=True):
        assert abs(moment - expected) < 4 * (spread / count) ** 0.5
    flat = noise.flatten(1)
    for first, second in ((flat[:, :-1], flat[:, 1:]), (flat[:, :-2], flat[:, 2:]), (flat[:-1], flat[1:])):
        assert abs((first * second).mean()) < 4 / first.numel() ** 0.5  # of neighbours in a row, and of rows


def test_counted_noise_of_a_row_depends_on_its_seed_alone():
    seeds = torch.tensor([5, 2**61, 0])
    all_rows = counted_noise(seeds, (7, 3))
    assert torch.equal(all_rows[1:2], counted_noise(seeds[1:2], (7, 3)))
    assert torch.equal(counted_noise(seeds.flip(0), (7, 3)).flip(0), all_rows)
    assert not torch.equal(all_rows[0], all_rows[2])
    assert counted_noise(seeds[:0], (7, 3)).shape == (0, 7, 3)
