"""The alarm on curves made by hand."""

from __future__ import annotations

import itertools

import pytest
import torch

from worldenv_trl.metrics import HonestyAlarm
from worldenv_trl.metrics.alarm import _sign_flip_test

CONTEXTS, PROBES = 48, 11


def first_alarm(imagined, real, seed: int, probes: int = PROBES, contexts: int = CONTEXTS) -> int | None:
    """Number of the first probe that fires; ``imagined`` and ``real`` give the true rates at probe 0, 1, ..."""
    generator = torch.Generator().manual_seed(seed)
    alarm = HonestyAlarm(probes)
    hardness = 0.15 * torch.randn(contexts, generator=generator)  # contexts differ
    for probe in range(probes):
        outcomes = [torch.rand(contexts, generator=generator) < rate(probe) + hardness for rate in (imagined, real)]
        if alarm.update(*outcomes).fired:
            return probe
    return None


def ramp(start: float, end: float, over: int = 5):
    return lambda probe: start + (end - start) * min(1.0, probe / over)


def test_noise_around_flat_rates_fires_in_at_most_five_per_cent_of_the_runs():
    fired = sum(first_alarm(ramp(0.7, 0.7), ramp(0.7, 0.7), seed) is not None for seed in range(300))
    assert fired <= 15 + 2 * 3.8  # two standard deviations above 5 %


def test_two_curves_that_rise_together_do_not_fire():
    assert sum(first_alarm(ramp(0.5, 0.9), ramp(0.5, 0.9), seed) is not None for seed in range(100)) <= 2


def test_imagination_that_rises_while_the_real_rate_falls_fires_before_the_run_ends():
    probes = [first_alarm(ramp(0.65, 0.9), ramp(0.75, 0.5), seed) for seed in range(50)]
    assert sum(probe is not None and probe <= 7 for probe in probes) >= 45


def test_imagination_that_rises_alone_fires_in_most_runs():
    probes = [first_alarm(ramp(0.55, 0.9), ramp(0.6, 0.6), seed) for seed in range(50)]
    assert sum(probe is not None for probe in probes) >= 40


def test_a_probe_that_says_the_same_every_time_never_fires():
    alarm, same = HonestyAlarm(6), torch.arange(20) % 3 == 0
    assert not any(alarm.update(same, ~same).fired for _ in range(6))


def test_a_gap_that_opens_because_the_real_rate_falls_is_not_called_a_rise():
    alarm = HonestyAlarm(4, window=1)
    alarm.update(torch.ones(30), torch.ones(30))
    watch = alarm.update(torch.ones(30), torch.zeros(30))
    assert watch.p_value < 1e-6 and not watch.fired and watch.imagined_rise == 0 and watch.real_rise == -1


def test_the_numbers_name_what_moved():
    alarm = HonestyAlarm(4, window=1)
    alarm.update([False] * 20, [True] * 10 + [False] * 10)
    watch = alarm.update([True] * 16 + [False] * 4, [True] * 10 + [False] * 10)
    assert watch.fired and (watch.imagined_rise, watch.real_rise) == pytest.approx((0.8, 0.0))
    assert watch.p_value == pytest.approx(2.0**-16)


def test_the_sign_flip_test_counts_all_signs():
    differences = [2, -1, 1, 3, 0, -2]
    sizes = [abs(value) for value in differences if value]
    sums = [sum(s * v for s, v in zip(signs, sizes, strict=True)) for signs in itertools.product((1, -1), repeat=5)]
    expected = sum(value >= sum(differences) for value in sums) / len(sums)
    assert _sign_flip_test(torch.tensor(differences)) == pytest.approx(expected)
    assert _sign_flip_test(torch.zeros(4, dtype=torch.int64)) == 1.0


def test_bad_settings_and_probes_are_named():
    with pytest.raises(ValueError, match=r"false_alarm_rate must be in \(0, 1\), got 2"):
        HonestyAlarm(4, false_alarm_rate=2)
    with pytest.raises(ValueError, match="window=3, probes=4"):
        HonestyAlarm(4, window=3)
    alarm = HonestyAlarm(4)
    alarm.update([True, False], [True, True])
    with pytest.raises(ValueError, match="same contexts as before"):
        alarm.update([True], [True])


def test_an_alarm_goes_on_from_its_state():
    probes = [(torch.arange(16) < count, torch.arange(16) < 4) for count in (4, 5, 12, 14)]
    whole, first, second = (HonestyAlarm(4, window=1) for _ in range(3))
    expected = [whole.update(*probe) for probe in probes]
    for probe in probes[:2]:
        first.update(*probe)
    second.load_state_dict(first.state_dict())
    assert [second.update(*probe) for probe in probes[2:]] == expected[2:]
    assert expected[-1].fired and not HonestyAlarm(4, window=1).update(*probes[-1]).fired
