from __future__ import annotations

import pytest
import torch

from worldenv_trl.world_models.cells import from_cells, to_cells, to_float, to_uint8


@pytest.mark.parametrize("patch", [1, 2, 4])
def test_cells_hold_the_pixels_of_a_patch_and_are_undone(patch):
    images = torch.randint(0, 256, (2, 3, 16, 16), dtype=torch.uint8)
    cells = to_cells(images, patch)
    expected = torch.nn.functional.pixel_unshuffle(images.float(), patch).unflatten(1, (3, -1))
    assert torch.equal(cells.float(), expected)
    assert torch.equal(from_cells(cells, patch), images)


def test_every_intensity_survives_the_way_to_floats_and_back():
    images = torch.arange(256, dtype=torch.uint8).view(1, 16, 16)
    floats = to_float(images)
    assert floats.min() == -1 and floats.max() == 1
    assert torch.equal(to_uint8(floats), images)


def test_colours_out_of_range_are_cut_off():
    assert to_uint8(torch.tensor([-3.0, 3.0])).tolist() == [0, 255]
