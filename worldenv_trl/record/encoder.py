"""Entries of rollouts to messages: many steps at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from worldenv_trl.keys import CONTROL_HZ, FRAMES, STATE, STEP_MASK
from worldenv_trl.record.layout import Entry, Layout, to_bytes
from worldenv_trl.record.mcap_file import McapFile
from worldenv_trl.record.messages import LOG, POSE, RAW_IMAGE, hand_poses, images, log

__all__ = ["PERIOD_NS", "RolloutEncoder"]

PERIOD_NS = 1_000_000_000 // CONTROL_HZ
_Path = tuple[str, ...]
_Queue = list[list[tuple[int, int, bytes]]]  # for each step: channel, time, message


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

    def reset(self, rollouts: Sequence[int], starts: Sequence[int], values: Mapping[_Path, Tensor]) -> None:
        """The first observations [n, ...] of rollouts."""
        numbers = np.array(rollouts, np.int64)[:, None].view(np.uint8)
        chained = [to_bytes(values[e.key]) for e in self.layout.numbers if e.chained]
        channel = self.file.channel(f"{self.prefix}/reset", self._reset.name, self._reset_schema)
        queue: _Queue = [
            [(channel, time, data)] for time, data in zip(starts, self._reset.pack([numbers, *chained]), strict=True)
        ]
        for entry in self.layout.images:
            if entry.stored in ("chained", "last_of_frames"):
                self._queue_images(queue, entry, values[entry.key], starts)
        self._add(queue, rollouts)

    def steps(
        self, rollouts: Sequence[int], steps: Sequence[int], starts: Sequence[int], values: Mapping[_Path, Tensor]
    ) -> None:
        """Entries [n, ...], root and next: the ``steps[i]``-th of rollout ``rollouts[i]``, which began at
        ``starts[i]``."""
        period = self.layout.steps_per_entry * PERIOD_NS
        before = [start + step * period for start, step in zip(starts, steps, strict=True)]
        after = [time + period for time in before]
        queue: _Queue = [[] for _ in rollouts]
        for entry in self.layout.images:
            if entry.stored == "last_of_frames":
                continue
            if entry.stored == "root":
                self._queue_images(queue, entry, values[entry.key], before)
            else:
                executed = None
                if entry.key == (FRAMES,) and self.layout.splits_frames:
                    executed = values["next", STEP_MASK].sum(-1).tolist()
                times = [time + PERIOD_NS for time in before]
                self._queue_images(queue, entry, values["next", *entry.key], times, executed)
        state = values.get(("next", *STATE))
        if state is not None and state.shape[-1] == 7:
            channel = self.file.channel("/hand", *POSE)
            for place, (time, data) in enumerate(zip(after, hand_poses(state, after), strict=True)):
                queue[place].append((channel, time, data))
        index = [np.array(each, np.int64)[:, None].view(np.uint8) for each in (rollouts, steps)]
        packed = self._step.pack([*index, *(to_bytes(values[key]) for _, key in self._numbers)])
        channel = self.file.channel(f"{self.prefix}/step", self._step.name, self._step_schema)
        for place, (time, data) in enumerate(zip(after, packed, strict=True)):
            queue[place].append((channel, time, data))
        self._add(queue, rollouts)

    def say(self, rollout: int, time_ns: int, text: str, outcome: str) -> None:
        """What was asked for, and how it ended."""
        said = f"rollout {rollout}: {text}{': ' + outcome if outcome else ''}"
        self.file.add([(self.file.channel("/instruction", *LOG), time_ns, log(said, time_ns), rollout)])

    def _queue_images(
        self, queue: _Queue, entry: Entry, values: Tensor, times: Sequence[int], executed: Sequence[int] | None = None
    ) -> None:
        """Images [n, (C,) 3, H, W] from ``times`` on, a period apart; those past ``executed`` on their own topic."""
        values = values.unsqueeze(1) if values.ndim == 4 else values  # [n, C, 3, H, W]
        count = values.shape[1]
        pixels = torch.stack(values.flatten(0, 1).unbind(1), -1).numpy()  # [n C, H, W, 3]; thrice as fast as permute
        stamps = [time + place * PERIOD_NS for time in times for place in range(count)]
        seen = self.file.channel(self.prefix + entry.topic, *RAW_IMAGE)
        late = seen
        if executed is not None and min(executed, default=count) < count:
            late = self.file.channel(f"{self.prefix}{entry.topic}/after_stop", *RAW_IMAGE)
        for place, (time, data) in enumerate(zip(stamps, images(pixels, stamps), strict=True)):
            row, inside = divmod(place, count)
            past = executed is not None and inside >= executed[row]
            queue[row].append((late if past else seen, time, data))

    def _add(self, queue: _Queue, rollouts: Sequence[int]) -> None:
        self.file.add(
            (channel, time, data, rollout)
            for messages, rollout in zip(queue, rollouts, strict=True)
            for channel, time, data in messages
        )
