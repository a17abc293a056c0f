"""The choice of the stopping rule, on scores made by hand."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from train_reflector import _FrameSampler, choose_rule, episode_figures, stops
from worldenv_trl import keys

FRAMES = 12


def episodes(first_success: list[int]) -> TensorDict:
    """One episode each; -1 never succeeds."""
    time = torch.arange(FRAMES)
    success = torch.stack([(time >= first) if first >= 0 else time < 0 for first in first_success])
    length = torch.full((len(first_success), 1), FRAMES - 1)
    task = torch.zeros(len(first_success), 1, dtype=torch.int64)
    return TensorDict({"success": success, "length": length, keys.TASK_ID: task}, batch_size=[len(first_success)])


def test_a_rule_stops_at_the_end_of_the_first_run_above_the_threshold():
    scores = torch.zeros(2, FRAMES)
    scores[0, [2, 5, 6, 7]] = 0.9
    scores[1, 4] = 0.9
    data = episodes([5, -1])
    assert stops(scores, data, (0.5, 1)).tolist() == [2, 4]
    assert stops(scores, data, (0.5, 2)).tolist() == [6, -1]
    assert episode_figures(scores, data, (0.5, 1)) == {"stop_precision": 0.0, "stop_recall": 0.0}
    assert episode_figures(scores, data, (0.5, 2)) == {"stop_precision": 1.0, "stop_recall": 1.0}


def test_a_stop_before_the_goal_is_right_only_if_it_may_come_late():
    scores = torch.zeros(1, FRAMES)
    scores[0, 4:] = 0.9
    data = episodes([6])
    assert episode_figures(scores, data, (0.5, 1), late=1)["stop_recall"] == 0.0
    assert episode_figures(scores, data, (0.5, 1), late=2)["stop_recall"] == 1.0


def test_the_rule_with_the_fewest_wrong_stops_is_chosen():
    data = episodes([5, 6, -1, -1])
    flickering, doubtful = torch.zeros(2, 4, FRAMES).unbind(0)
    flickering[:2, 6:], doubtful[:2, 6:] = 0.97, 0.97
    flickering[2:, 3] = 0.99  # one frame is not enough here
    doubtful[2:, 3:] = 0.85  # sure of itself for long, but never above 0.9: the threshold must be high
    assert choose_rule(flickering, data)[1] > 1
    assert choose_rule(doubtful, data)[0] >= 0.9


def test_a_wrong_stop_costs_more_than_a_missed_one():
    data = episodes([6] * 10 + [-1] * 4)
    scores = torch.zeros(14, FRAMES)
    scores[:7, 6:] = 0.97  # above 0.9, seven of ten are found; above 0.5 all of them, and three that are none
    scores[7:10, 6:], scores[10:13, 6:] = 0.7, 0.7
    assert choose_rule(scores, data)[0] >= 0.7


def test_a_rare_task_weighs_as_much_as_a_common_one():
    data = episodes([6] * 20 + [6, -1])
    data[keys.TASK_ID][20:] = 1
    scores = torch.zeros(22, FRAMES)
    scores[:20, 6:] = 0.65
    scores[20, 6:], scores[21, 3] = 0.97, 0.9
    assert choose_rule(scores, data) == (0.5, 2)  # not (0.5, 1), which is right 21 times in 22 as well


def test_frames_are_drawn_evenly_over_tasks_and_outcomes_and_never_past_the_end():
    data = episodes([10, 3, 2, -1, 1])
    data[keys.TASK_ID] = torch.tensor([[0], [1], [1], [1], [1]])
    data["length"] = torch.tensor([[FRAMES - 1], [5], [FRAMES - 1], [4], [FRAMES - 1]])
    row, frame = _FrameSampler(data)(4000)
    assert len(row) == 4000 and (frame <= data["length"][row].squeeze(-1)).all()
    for task in (0, 1):
        drawn = data[keys.TASK_ID][row].squeeze(-1) == task
        assert int(drawn.sum()) == 2000
        assert int(data["success"][row, frame][drawn].sum()) == 1000
