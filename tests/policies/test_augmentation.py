from __future__ import annotations

import pytest
import torch

from worldenv_trl.policies import random_shift


def test_every_image_is_a_whole_shift_of_itself_with_a_repeated_border():
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (64, 3, 12, 10), dtype=torch.uint8, generator=generator)
    shifted = random_shift(images, 2, generator)
    assert shifted.dtype == torch.uint8
    seen = set()
    for image, result in zip(images, shifted, strict=True):
        padded = torch.nn.functional.pad(image[None].float(), (2, 2, 2, 2), mode="replicate")[0].byte()
        matches = [(i, j) for i in range(5) for j in range(5) if torch.equal(padded[:, i : i + 12, j : j + 10], result)]
        assert len(matches) == 1
        seen.update(matches)
    assert len(seen) > 15  # of 25 possible shifts


def test_leading_dimensions_are_kept_and_the_input_is_not_changed():
    images = torch.rand(2, 3, 3, 16, 16)
    copy = images.clone()
    assert random_shift(images, 3).shape == images.shape
    assert torch.equal(images, copy)


def test_a_shift_of_zero_is_a_copy():
    images = torch.rand(2, 3, 8, 8)
    result = random_shift(images, 0)
    assert torch.equal(result, images)
    assert result.data_ptr() != images.data_ptr()


@pytest.mark.parametrize("pixels", [-1, 8])
def test_a_shift_outside_the_image_is_refused(pixels):
    with pytest.raises(ValueError, match=f"got {pixels}"):
        random_shift(torch.zeros(1, 3, 8, 8), pixels)
