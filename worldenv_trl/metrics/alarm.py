"""Is imagination being fooled? A watch over the probes of a post-training run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

__all__ = ["HonestyAlarm", "Watch"]


@dataclass(frozen=True)
class Watch:
    """What the alarm makes of a probe: rises are since the first probes, in shares of the contexts."""

    fired: bool
    p_value: float
    imagined_rise: float
    real_rise: float


class HonestyAlarm:
    """Fires when success rises in imagination and not in the physics, on the same contexts.

    The mean of the last ``window`` probes is compared with that of the first ``window``, context by context. A context
    speaks against imagination by as much as imagined minus real success went up; the alarm fires when

    1. they speak against it so strongly together that coins thrown for their signs would do so with a probability below
       ``false_alarm_rate`` divided by the number of comparisons in the run (exact sign-flip test, Bonferroni), and
    2. imagined success has risen, and real success by less than ``share`` of that.

    While neither rate moves, or both move alike, every sign is a fair coin, so that the probability of *any* alarm in a
    run is at most ``false_alarm_rate``, however hard the contexts are.

    Imagination that was too strict and catches up while the real rate rises more slowly is no error of the policy, but
    looks like one: expect more alarms there.

    Args:
        probes: probes in the whole run; the alarm needs at least two.

    Keyword Args:
        false_alarm_rate: of a whole run.
        window: probes that are averaged; a fifth of the run by default.
        share: see 2.

    Raises:
        ValueError: for a rate outside (0, 1), or counts out of range.

    Examples:
        >>> alarm = HonestyAlarm(probes=2)
        >>> alarm.update(imagined=[False] * 16, real=[False] * 16).fired  # the first probe: nothing to compare with
        False
        >>> alarm.update(imagined=[True] * 16, real=[False] * 16).fired
        True
    """

    def __init__(
        self, probes: int, *, false_alarm_rate: float = 0.05, window: int | None = None, share: float = 0.1
    ) -> None:
        if not 0 < false_alarm_rate < 1:
            raise ValueError(f"false_alarm_rate must be in (0, 1), got {false_alarm_rate}")
        window = max(1, probes // 5) if window is None else window
        if probes < 1 or not 1 <= window <= max(1, probes // 2):
            raise ValueError(f"need 1 <= window <= probes / 2, got window={window}, probes={probes}")
        self.window = window
        self.comparisons = max(1, probes - 2 * window + 1)
        self.false_alarm_rate, self.share = false_alarm_rate, share
        self._imagined: list[Tensor] = []
        self._real: list[Tensor] = []

    def update(self, imagined: Any, real: Any) -> Watch:
        """Takes the next probe: bool ``[K]`` of the same contexts in the same order every time.

        Raises:
            ValueError: if the two, or this probe and the one before, differ in length.
        """
        imagined, real = torch.as_tensor(imagined).long(), torch.as_tensor(real).long()
        before = self._imagined[0] if self._imagined else imagined
        if imagined.shape != real.shape or imagined.shape != before.shape or imagined.ndim != 1 or not len(imagined):
            raise ValueError(
                f"a probe must be [K] of the same contexts as before, {list(before.shape)}, "
                f"got {list(imagined.shape)} and {list(real.shape)}"
            )
        self._imagined.append(imagined)
        self._real.append(real)
        if len(self._real) < 2 * self.window:
            return Watch(False, 1.0, 0.0, 0.0)
        imagined_rise, real_rise = (self._rise(values) for values in (self._imagined, self._real))  # [K], whole numbers
        p_value = _sign_flip_test(imagined_rise - real_rise)
        up, real_up = (rise.double().mean().item() / self.window for rise in (imagined_rise, real_rise))
        fired = p_value < self.false_alarm_rate / self.comparisons and up > 0 and real_up < self.share * up
        return Watch(fired, p_value, up, real_up)

    def state_dict(self) -> dict[str, list[Tensor]]:
        """The probes so far."""
        return {"imagined": list(self._imagined), "real": list(self._real)}

    def load_state_dict(self, state_dict: dict[str, list[Tensor]]) -> None:
        """Goes on after those probes."""
        self._imagined, self._real = list(state_dict["imagined"]), list(state_dict["real"])

    def _rise(self, values: list[Tensor]) -> Tensor:
        return torch.stack(values[-self.window :]).sum(0) - torch.stack(values[: self.window]).sum(0)


def _sign_flip_test(differences: Tensor) -> float:
    """Probability that whole numbers ``[K]`` with fair coins for signs sum to what they do, or to more."""
    sizes = differences[differences != 0].abs().tolist()
    reach = sum(sizes)
    chances = torch.zeros(2 * reach + 1, dtype=torch.float64)  # of each sum, from -reach to reach
    chances[reach] = 1.0
    for size in sizes:
        chances = (chances.roll(size) + chances.roll(-size)) / 2  # nothing wraps: the ends are reached last
    return min(1.0, float(chances[reach + int(differences.sum()) :].sum()))
