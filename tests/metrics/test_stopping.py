"""Figures of scores and stops, and the choice of a rule, on scores made by hand."""

from __future__ import annotations

import pytest
import torch

from worldenv_trl.metrics import (
    choose_rule,
    first_success,
    frame_figures,
    judged,
    largest_scores,
    loop_returns,
    stop_figures,
)
from worldenv_trl.reflectors import StopRule

FRAMES = 12


def episodes(first_success: list[int]):
    """Success and alive of one episode each; -1 never succeeds."""
    time = torch.arange(FRAMES)
    success = torch.stack([(time >= first) if first >= 0 else time < 0 for first in first_success])
    return success, torch.ones_like(success)


def chosen(scores, data, task=None):
    return choose_rule(scores, *data, torch.zeros(len(scores), 1) if task is None else task)


def test_a_stop_is_right_once_the_goal_is_reached():
    scores = torch.zeros(2, FRAMES)
    scores[0, [2, 5, 6, 7]] = 0.9
    scores[1, 4] = 0.9
    data = episodes([5, -1])
    assert stop_figures(scores, *data, StopRule(0.5, 1)) == {"stop_precision": 0.0, "stop_recall": 0.0}
    assert stop_figures(scores, *data, StopRule(0.5, 2)) == {"stop_precision": 1.0, "stop_recall": 1.0}


def test_a_stop_before_the_goal_is_right_only_if_it_may_come_late():
    scores = torch.zeros(1, FRAMES)
    scores[0, 4:] = 0.9
    data = episodes([6])
    assert stop_figures(scores, *data, StopRule(), late=1)["stop_recall"] == 0.0
    assert stop_figures(scores, *data, StopRule(), late=2)["stop_recall"] == 1.0


def test_frames_past_the_end_of_an_episode_do_not_stop_it():
    success, alive = episodes([2])
    scores = torch.full((1, FRAMES), 0.1)
    scores[0, 8:], alive[0, 8:] = 0.9, False
    assert stop_figures(scores, success, alive, StopRule())["stop_recall"] == 0.0


def test_frames_are_figured_where_they_belong_to_their_episode():
    success, alive = episodes([6, -1])
    scores = torch.where(success, 0.9, 0.1)
    scores[1, 9:], alive[1, 9:] = 0.9, False
    assert frame_figures(scores, success, alive) == {
        "frame_precision": 1.0, "frame_recall": 1.0, "frame_f1": 1.0, "frame_auc": 1.0,
    }  # fmt: skip
    assert frame_figures(scores, success, torch.ones_like(alive))["frame_precision"] == pytest.approx(6 / 9)


def test_the_rule_with_the_fewest_wrong_stops_is_chosen():
    data = episodes([5, 6, -1, -1])
    flickering, doubtful = torch.zeros(2, 4, FRAMES).unbind(0)
    flickering[:2, 6:], doubtful[:2, 6:] = 0.97, 0.97
    flickering[2:, 3] = 0.99  # one frame is not enough here
    doubtful[2:, 3:] = 0.85  # sure of itself for long, but never above 0.9: the threshold must be high
    assert chosen(flickering, data).consecutive > 1
    assert chosen(doubtful, data).threshold >= 0.9


def test_a_wrong_stop_costs_more_than_a_missed_one():
    data = episodes([6] * 10 + [-1] * 4)
    scores = torch.zeros(14, FRAMES)
    scores[:7, 6:] = 0.97  # above 0.9, seven of ten are found; above 0.5 all of them, and three that are none
    scores[7:10, 6:], scores[10:13, 6:] = 0.7, 0.7
    assert chosen(scores, data).threshold >= 0.7


def test_a_rare_task_weighs_as_much_as_a_common_one():
    data, task = episodes([6] * 20 + [6, -1]), torch.tensor([0] * 20 + [1, 1])
    scores = torch.zeros(22, FRAMES)
    scores[:20, 6:] = 0.65
    scores[20, 6:], scores[21, 3] = 0.97, 0.9
    assert chosen(scores, data, task) == StopRule(0.5, 2)  # not (0.5, 1), which is right 21 times in 22 as well


def test_a_stop_ends_the_episode_and_may_come_a_little_early():
    stop, reached = torch.tensor([10, 10, 10, 10, -1, -1]), torch.tensor([8, 12, 13, -1, 30, -1])
    imagined, real = judged(stop, reached)
    assert imagined.tolist() == [True, True, True, True, False, False]
    assert real.tolist() == [True, True, False, False, True, False]
    assert judged(stop, reached, late=0)[1].tolist() == [True, False, False, False, True, False]


def test_the_first_success_is_found():
    success = torch.tensor([[False, True, False], [False, False, False], [True, True, True]])
    assert first_success(success).tolist() == [1, -1, 0]


def test_the_return_is_r_where_the_rollout_ends():
    scores = torch.rand(50, FRAMES, generator=torch.Generator().manual_seed(0))
    length = torch.randint(1, FRAMES, (50,), generator=torch.Generator().manual_seed(1))
    alive, rule = torch.arange(FRAMES) <= length.unsqueeze(-1), StopRule(0.6, 2)
    expected = []
    for row in range(50):
        streak = 0
        for frame in range(1, int(length[row]) + 1):
            streak = streak + 1 if scores[row, frame] > rule.threshold else 0
            if streak == rule.consecutive:
                break
        expected.append(scores[row, frame].item())
    assert loop_returns(scores, rule.first(scores, alive), alive).tolist() == expected


def test_the_largest_score_is_of_frames_that_were_lived():
    scores = torch.tensor([[0.9, 0.2, 0.4, 0.8], [0.3, 0.9, 0.9, 0.9]])
    alive = torch.tensor([[True, True, True, False], [True, False, False, False]])
    assert largest_scores(scores, alive).tolist() == pytest.approx([0.4, 0.3])
