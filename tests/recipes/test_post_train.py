"""The honest probe and its alarm."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

import post_train
from config import PRESETS, PostTrain
from parts import exploring_actor
from worldenv_trl import keys
from worldenv_trl.metrics import HonestyAlarm
from worldenv_trl.policies import OFTConfig, OFTPolicy


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


def test_iterations_that_stop_after_their_first_update_are_counted_and_said():
    logged = [(1, 1.0), (18, 0.0), (1, 1.0), (0, 1.0), (1, 1.0), (1, 0.0)]
    counts, stuck = [], 0
    for updates, kl_stop in logged:
        stuck = post_train._stuck(stuck, {"updates": updates, "kl_stop": kl_stop})
        counts.append(stuck)
    assert counts == [1, 0, 1, 2, 3, 0]
    said = post_train._STUCK.format("post_train", 4, 3, 0.1)
    assert "for 3 iterations the first update alone has moved the policy by more than max_kl=0.1" in said


def test_the_scale_is_bounded_below_by_what_the_demonstrations_use_of_each_dimension():
    torch.manual_seed(0)
    policy = OFTPolicy(OFTConfig.for_tasks({0: "do it"}, dim=32, depth=1))
    half = torch.tensor([0.2, 0.3, 0.4, 0.0, 0.0, 0.16, 1.0])  # the hand turns about one axis
    policy.fit_statistics(torch.rand(500, 7), half * (2 * torch.rand(500, 7) - 1))
    torch.nn.init.constant_(policy.scale_head.linear_out.bias, -20.0)  # a scale head that is far too sure
    actor = exploring_actor(PRESETS["smoke"][1], policy, 1.0)
    batch = {"observation": {"image": torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(2, 7)}}
    scale = actor(TensorDict({**batch, keys.TASK_ID: torch.zeros(2, 1, dtype=torch.int64)}, [2]))[keys.SCALE]
    used = policy.action_half_range
    expected = torch.tensor([0.04, 0.04, 0.125 * used[2], 0.0025, 0.0025, 0.125 * used[5], 0.15])
    assert torch.allclose(scale, expected.expand_as(scale)) and 0.018 < expected[5] < 0.021
    # An update that moves every mean by as much of its range moves none of them by a multiple of the others' scale.
    assert (used / expected).max() / (used / expected)[:3].min() < 3
