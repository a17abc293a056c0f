"""Seeds of the world model's noise."""

from __future__ import annotations

import torch

from worldenv_trl.world_models.noise_seeds import noise_seeds


def test_noise_seeds_are_splitmix64_of_their_parts():
    """The reference counts in Python's integers, which do not wrap."""

    def mix(value: int) -> int:
        value = (value + 0x9E3779B97F4A7C15) % 2**64
        value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
        value = (value ^ (value >> 27)) * 0x94D049BB133111EB % 2**64
        return value ^ (value >> 31)

    parts = torch.tensor([[0, 0, 1, 2**40], [0, 1, 0, 7]])
    expected = []
    for column in parts.T.tolist():
        mixed = 11
        for part in column:
            mixed = mix(mixed ^ mix(part + 1))
        expected.append(mixed % 2**62)
    assert noise_seeds(11, *parts).tolist() == expected
    assert not torch.equal(noise_seeds(11, *parts), noise_seeds(11, *parts.flip(0)))
