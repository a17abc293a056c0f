"""The one rule of stopping against a slow reference."""

from __future__ import annotations

import itertools

import pytest
import torch

from worldenv_trl.reflectors import StopRule


def slow_first(scores, alive, rule):
    """Frame by frame, in Python."""
    run = 0
    for frame in range(1, len(scores)):
        run = run + 1 if alive[frame] and scores[frame] > rule.threshold else 0
        if run == rule.consecutive:
            return frame
    return -1


def videos(seed, rows=60, frames=19):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(rows, frames, generator=generator)
    scores[rows // 2 :] = 1 - 0.4 * scores[rows // 2 :]  # long runs, too
    length = torch.randint(0, frames, (rows, 1), generator=generator)
    return scores, torch.arange(frames) <= length


@pytest.mark.parametrize(
    "rule", [StopRule(*pair) for pair in itertools.product((0.05, 0.5, 0.7, 0.95), (1, 2, 3, 7, 19, 40))], ids=str
)
def test_whole_videos_and_chunks_of_any_length_stop_where_the_slow_rule_stops(rule):
    scores, alive = videos(rule.consecutive)
    expected = [slow_first(*video, rule) for video in zip(scores.tolist(), alive.tolist(), strict=True)]
    assert rule.first(scores, alive).tolist() == expected
    for length in (1, 4, 18):
        streak, stopped = torch.zeros(len(scores), dtype=torch.int64), torch.full((len(scores),), -1)
        for start in range(1, scores.shape[1], length):
            chunk = slice(start, start + length)
            stop, last, streak = rule.extend(streak, scores[:, chunk], alive[:, chunk])
            stopped = torch.where((stopped < 0) & stop, start + last, stopped)
        assert stopped.tolist() == expected


def test_the_last_frame_of_a_row_that_goes_on_is_its_last_executed_one():
    scores, executed = torch.zeros(3, 4), torch.arange(4) < torch.tensor([[4], [2], [0]])
    stop, last, _ = StopRule().extend(torch.zeros(3, dtype=torch.int64), scores, executed)
    assert not stop.any() and last.tolist() == [3, 1, -1]


def test_the_first_frame_never_stops_and_a_score_at_the_threshold_does_not():
    alive = torch.ones(2, 3, dtype=torch.bool)
    assert StopRule(0.5).first(torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.5, 0.6]]), alive).tolist() == [-1, 2]
    assert StopRule(0.5).first(torch.tensor([[0.9], [0.9]]), alive[:, :1]).tolist() == [-1, -1]


@pytest.mark.parametrize("settings", [(0.0, 1), (1.0, 1), (float("nan"), 1), (0.5, 0), (0.5, 1.5), (0.5, float("nan"))])
def test_rules_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match="got"):
        StopRule(*settings)
