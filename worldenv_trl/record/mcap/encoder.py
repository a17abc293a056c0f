"""Entries of rollouts to messages: many steps at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from worldenv_trl.keys import CONTROL_HZ, STATE, STEP_MASK
from worldenv_trl.record.mcap.file import McapFile
from worldenv_trl.record.mcap.layout import Entry, Layout, to_bytes
from worldenv_trl.record.mcap.messages import (
    LOG,
    POSE,
    POSE_BYTES,
    RAW_IMAGE,
    fill_images,
    fill_poses,
    image_bytes,
    log,
)

__all__ = ["PERIOD_NS", "RolloutEncoder"]

PERIOD_NS = 1_000_000_000 // CONTROL_HZ
_Path = tuple[str, ...]
_Numbers = Sequence[int] | np.ndarray


class RolloutEncoder:
    """Adds the messages of rollouts of one layout to a file.

    A rollout plays from its ``start`` (ns) on, an entry every ``steps_per_entry`` control periods. A step's message
    comes after its images: a step whose message is in the file is complete.
    """

    def __init__(self, file: McapFile, layout: Layout, prefix: str) -> None:
        self.file, self.layout, self.prefix = file, layout, prefix
        self._step, self._reset = layout.step_message(), layout.reset_message()
        self._step_schema, self._reset_schema = self._step.schema(), self._reset.schema()
        self._numbers = [(e, e.key if e.stored == "root" else ("next", *e.key)) for e in layout.numbers]

    def duration(self, steps: int) -> int:
        """How long (ns) a rollout of so many entries plays, with the reset."""
        return (steps * self.layout.steps_per_entry + 1) * PERIOD_NS

    def reset(self, rollouts: _Numbers, starts: _Numbers, values: Mapping[_Path, Tensor]) -> None:
        """The first observations [n, ...] of rollouts."""
        numbers, times = np.asarray(rollouts, np.int64), np.asarray(starts, np.int64)
        chained = [to_bytes(values[e.key]) for e in self.layout.numbers if e.chained]
        channel = self.file.channel(f"{self.prefix}/reset", self._reset.name, self._reset_schema)
        messages = self.file.block(channel, times, numbers, self._reset.nbytes)
        self._reset.fill(messages, [_raw(numbers), *chained])
        for entry in self.layout.images:
            if entry.stored in ("chained", "last_of_frames"):
                self._images(entry, values[entry.key], times, numbers)

    def steps(self, rollouts: _Numbers, steps: _Numbers, starts: _Numbers, values: Mapping[_Path, Tensor]) -> None:
        """Entries [n, ...], root and next: the ``steps[i]``-th of rollout ``rollouts[i]``, which began at
        ``starts[i]``."""
        period = self.layout.steps_per_entry * PERIOD_NS
        numbers, places = np.asarray(rollouts, np.int64), np.asarray(steps, np.int64)
        before = np.asarray(starts, np.int64) + places * period
        after = before + period
        for entry in self.layout.images:
            if entry.stored == "root":
                self._images(entry, values[entry.key], before, numbers)
            elif entry.stored != "last_of_frames":
                executed = values["next", STEP_MASK].sum(-1).numpy() if self.layout.splits(entry) else None
                self._images(entry, values["next", *entry.key], before + PERIOD_NS, numbers, executed)
        state = values.get(("next", *STATE))
        if state is not None and state.shape[-1] == 7:
            fill_poses(self.file.block(self.file.channel("/hand", *POSE), after, numbers, POSE_BYTES), state, after)
        channel = self.file.channel(f"{self.prefix}/step", self._step.name, self._step_schema)
        messages = self.file.block(channel, after, numbers, self._step.nbytes)
        fields = [to_bytes(values[key]) for _, key in self._numbers]
        self._step.fill(messages, [_raw(numbers), _raw(places), *fields])

    def say(self, rollout: int, time_ns: int, text: str, outcome: str) -> None:
        """What was asked for, and how it ended."""
        said = f"rollout {rollout}: {text}{': ' + outcome if outcome else ''}"
        self.file.add(self.file.channel("/instruction", *LOG), time_ns, log(said, time_ns), rollout)

    def _images(
        self, entry: Entry, values: Tensor, times: np.ndarray, numbers: np.ndarray, executed: np.ndarray | None = None
    ) -> None:
        """Images [n, (C,) 3, H, W] from ``times`` on, a period apart; those past ``executed`` on their own topic."""
        values = values.unsqueeze(1) if values.ndim == 4 else values  # [n, C, 3, H, W]
        count, (height, width) = values.shape[1], values.shape[-2:]
        flat = values.flatten(0, 1).numpy()
        times = (times[:, None] + PERIOD_NS * np.arange(count)).reshape(-1)
        numbers = np.repeat(numbers, count)
        late = np.zeros(len(flat), bool) if executed is None else (np.arange(count) >= executed[:, None]).reshape(-1)
        for topic, chosen in ((entry.topic, ~late), (f"{entry.topic}/after_stop", late)):
            if not chosen.any():
                continue
            everyone = chosen.all()
            shown, at, of = (each if everyone else each[chosen] for each in (flat, times, numbers))
            channel = self.file.channel(self.prefix + topic, *RAW_IMAGE)
            fill_images(self.file.block(channel, at, of, image_bytes(height, width)), shown, at)


def _raw(numbers: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(numbers)[:, None].view(np.uint8)
