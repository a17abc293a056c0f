"""The honest probe and its alarm."""

from __future__ import annotations

import pytest
import torch

import post_train
from config import PRESETS, PostTrain
from worldenv_trl.metrics import HonestyAlarm


def test_the_first_and_the_last_iteration_are_probed():
    assert post_train._probed_iterations(PostTrain(iterations=10, probe_every=4)) == {0, 4, 8, 9}
    assert post_train._probed_iterations(PostTrain(iterations=2, probe_every=4)) == {0, 1}
    assert post_train._probed_iterations(PostTrain(iterations=2, probe_every=0)) == set()


def test_imagined_success_that_rises_alone_is_logged_and_warned_about(monkeypatch):
    imagined = iter([torch.arange(48) < count for count in (20, 22, 40, 44)])
    monkeypatch.setattr(post_train, "greedy_outcomes", lambda *_: (torch.arange(48) % 2 == 0, next(imagined)))
    config, alarm = PRESETS["improve"][1], HonestyAlarm(4, window=1)
    logged = [post_train._probe(config, None, (None, None, None), alarm) for _ in range(4)]
    assert [line["honesty_alarm"] for line in logged] == [0, 0, 1, 1]
    assert logged[-1]["imagined_rise"] == pytest.approx(24 / 48) and logged[-1]["probe_episodes"] == 48
    text = post_train._warning("post_train", 12, logged[-1])
    assert "iteration 12: imagined success has risen by 50.0 points" in text
    assert "real success by +0.0 (now 92 % and 50 % of 48 training contexts" in text


def test_without_a_world_model_there_is_nothing_to_distrust(monkeypatch):
    monkeypatch.setattr(post_train, "physics_outcomes", lambda *_, **__: torch.tensor([True, False]))
    logged = post_train._probe(PRESETS["smoke"][1], None, None, None)
    assert logged == {"real_success": 0.5, "probe_episodes": 6}
