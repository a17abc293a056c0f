from __future__ import annotations

import torch

from worldenv_trl.world_models.cells import from_cells, to_cells
from worldenv_trl.world_models.painter import Painter


def test_a_pixel_at_the_tool_can_follow_the_tool_exactly():
    painter = Painter(32, 2, 8, 8)
    image = torch.rand(1, 3, 32, 32)
    shift = torch.tensor([3.0, -2.0]).view(1, 1, 1, 1, 1, 2)
    moved = from_cells(painter.move(image, shift), 2)[0, 0]
    assert torch.allclose(moved[:, 4:26, 8:28], image[0, :, 6:28, 5:25], atol=1e-5)


def paint(bias: torch.Tensor | None = None, motion: float = 0.0, chunk: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames [1, C, 3, H, W] of a painter that listens to its ``bias`` [10] alone, and its memory [1, 3, 3, H, W]."""
    painter = Painter(32, 2, 8, 8)
    if bias is not None:
        painter.paint.bias.data = bias.repeat_interleave(4)
    memory = torch.rand(1, 3, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1
    away = torch.tensor([[1.0, 0.0, 9.0], [0.0, 1.0, 9.0]])  # the hand's texture is out of the picture
    with torch.no_grad():
        frames = painter(
            torch.zeros(chunk, 8, 16, 16),
            memory,
            torch.full((1, chunk, 2), motion),
            away.expand(1, chunk, 2, 3),
            torch.ones(1, chunk),
        )
    return from_cells(frames, 2), memory


def chosen(candidate: int) -> torch.Tensor:
    """A bias that chooses one of the five pictures; the painted colour is 0.1, 0.2, 0.3."""
    bias = torch.zeros(10)
    bias[candidate], bias[5:8] = 50.0, torch.tensor([0.1, 0.2, 0.3])
    return bias


def test_it_starts_as_a_copy_of_the_last_frame_mostly():
    frames, memory = paint()
    weight = torch.tensor([2.0, 0, 0, 0, -8.0]).softmax(0)  # last, first, moved last, paint (grey), hand (grey)
    expected = (weight[0] + weight[2]) * memory[:, -1:] + weight[1] * memory[:, :1]
    assert torch.allclose(frames, expected.expand_as(frames), atol=1e-5)


def test_it_can_show_the_last_or_the_first_frame_as_they_were():
    for candidate, place in ((0, -1), (1, 0)):
        frames, memory = paint(chosen(candidate), motion=3.0)
        assert torch.allclose(frames[0, 1], memory[0, place], atol=1e-5)


def test_it_can_show_the_last_frame_where_the_tool_carried_it():
    frames, memory = paint(chosen(2), motion=2.0)
    assert torch.allclose(frames[0, 0, :, 6:26, 6:26], memory[0, -1, :, 4:24, 4:24], atol=1e-5)


def test_it_can_paint_any_colour():
    frames, _ = paint(chosen(3))
    assert torch.allclose(frames, torch.tensor([0.1, 0.2, 0.3]).view(1, 1, 3, 1, 1).expand_as(frames), atol=1e-5)


def test_the_hands_texture_is_shown_where_its_plane_is_and_by_the_grippers_opening():
    painter = Painter(32, 2, 8, 8)
    painter.hand.data[:, 3] = painter.hand.data[:, 7] = 4.0  # 100 with the gain: the hand covers all else
    painter.hand.data[:, 0], painter.hand.data[:, 4] = 0.5 / 25, -0.5 / 25  # red: closed 0.5, open -0.5
    grid = torch.tensor([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])  # the texture fills the middle half of the picture
    sprite = from_cells(painter._hand(grid.expand(1, 3, 2, 3), torch.tensor([[0.0, 0.5, 1.0]])), 2)[0]
    assert torch.allclose(sprite[:, 0, 16, 16], torch.tensor([0.5, 0.0, -0.5]), atol=1e-5)
    assert (sprite[:, 3, 16, 16] > 50).all() and (sprite[:, 3, 2, 2] == -8).all()
    assert to_cells(sprite, 2).shape == (3, 4, 4, 16, 16)
