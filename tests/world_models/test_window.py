from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl.world_models import Window

IMAGE, WRIST = ("frames", "image"), ("frames", "wrist_image")


def make_window() -> Window:
    """Two rows; frames are 10 x camera + number, those of the second row 100 more."""
    number = torch.tensor([[0, 0, 3, 4, 5, 6, 7], [0, 9, 11, 12, 13, 14, 15]])
    values = number + torch.tensor([[0], [100]])
    frames = {IMAGE: values, WRIST: values + 10}
    return Window(
        TensorDict(
            {
                **{k: v.to(torch.uint8)[..., None, None, None].expand(-1, -1, 3, 4, 4) for k, v in frames.items()},
                "poses": values.float().unsqueeze(-1).expand(-1, -1, 13),
                "number": number,
                "start": torch.tensor([[3], [11]]),
                "actions": torch.zeros(2, 4, 7),
                "step_mask": torch.ones(2, 4, dtype=torch.bool),
            },
            batch_size=[2],
        )
    )


def shown(window: Window, numbers: list[list[int]], key=IMAGE) -> list[list[int]]:
    return window.recall(torch.tensor(numbers))[key][:, :, 0, 0, 0].tolist()


def test_frames_and_poses_are_found_by_their_numbers():
    window = make_window()
    assert shown(window, [[5, 0], [11, 15]]) == [[5, 0], [111, 115]]
    assert shown(window, [[5, 0], [11, 15]], WRIST) == [[15, 10], [121, 125]]
    assert window.recall(torch.tensor([[5, 0], [11, 15]]))["poses"][..., 7].tolist() == [[5.0, 0.0], [111.0, 115.0]]


def test_a_window_knows_where_it_starts_and_how_many_steps_it_learns():
    window = make_window()
    assert window.start.tolist() == [3, 11] and window.steps == 4


def test_a_number_that_a_window_does_not_hold_is_named():
    with pytest.raises(ValueError, match="frame 3 is not in window 1"):
        make_window().recall(torch.tensor([[3, 4], [11, 3]]))


def own(window: Window, rows: list[bool], numbers: list[list[int]], value: int, shown_window: Window) -> Window:
    painted = {
        IMAGE: torch.full((2, 2, 3, 4, 4), value, dtype=torch.uint8),
        WRIST: torch.full((2, 2, 3, 4, 4), value + 1, dtype=torch.uint8),
    }
    return window.with_own(torch.tensor(rows), torch.tensor(numbers), painted, shown_window)


def test_own_frames_take_the_place_of_real_ones_in_the_rows_that_ask_for_them():
    window = make_window()
    changed = own(window, [True, False], [[4, 5], [12, 13]], 200, window)
    assert shown(changed, [[3, 4, 5, 6], [11, 12, 13, 14]]) == [[3, 200, 200, 6], [111, 112, 113, 114]]
    assert shown(changed, [[3, 4, 5, 6], [11, 12, 13, 14]], WRIST) == [[13, 201, 201, 16], [121, 122, 123, 124]]


def test_own_frames_change_neither_poses_nor_the_window_they_came_from():
    window = make_window()
    changed = own(window, [True, True], [[4, 5], [12, 13]], 200, window)
    assert changed.recall(torch.tensor([[4], [12]]))["poses"][..., 0].tolist() == [[4.0], [112.0]]
    assert shown(window, [[4, 5], [12, 13]]) == [[4, 5], [112, 113]]


def test_rows_keep_their_own_frames_while_they_go_on_and_are_real_again_when_they_do_not():
    window = make_window()
    once = own(window, [True, True], [[4, 5], [12, 13]], 200, window)
    twice = own(window, [True, False], [[6, 7], [14, 15]], 230, once)
    assert shown(twice, [[4, 5, 6, 7], [12, 13, 14, 15]]) == [[200, 200, 230, 230], [112, 113, 114, 115]]


def test_a_frame_that_is_held_twice_is_shown_as_the_model_painted_it():
    """The memory of a later chunk is among the targets of an earlier one: there the model's own frame goes."""
    number = torch.tensor([[0, 2, 1, 2]])
    window = Window(
        TensorDict(
            {
                IMAGE: number.to(torch.uint8)[..., None, None, None].expand(-1, -1, 3, 4, 4),
                "poses": torch.zeros(1, 4, 13),
                "number": number,
                "start": torch.zeros(1, 1, dtype=torch.int64),
                "actions": torch.zeros(1, 2, 7),
                "step_mask": torch.ones(1, 2, dtype=torch.bool),
            },
            batch_size=[1],
        )
    )
    painted = {IMAGE: torch.full((1, 2, 3, 4, 4), 200, dtype=torch.uint8)}
    changed = window.with_own(torch.tensor([True]), torch.tensor([[1, 2]]), painted, window)
    assert shown(changed, [[0, 1, 2]]) == [[0, 200, 200]]
