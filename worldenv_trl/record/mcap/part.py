"""The rollouts of one write, or of one recorder: from their messages back to tensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from worldenv_trl.keys import STEP_MASK
from worldenv_trl.record.mcap.encoder import PERIOD_NS
from worldenv_trl.record.mcap.layout import Entry, Layout, from_bytes, same_camera
from worldenv_trl.record.mcap.messages import image_head
from worldenv_trl.record.mcap.protobuf import image_data

__all__ = ["Found", "Part", "lacks_messages"]

Found = dict[str, list[tuple[int, memoryview]]]  # the messages of a rollout by topic: time (ns) and data
_Path = tuple[str, ...]


def lacks_messages(file: Path, rollouts: tuple[int, int], steps: tuple[int, int]) -> ValueError:
    """The error for a whole file that holds fewer rollouts and steps than it announces: found, announced."""
    return ValueError(
        f"{file} lacks messages: {rollouts[0]} of {rollouts[1]} rollouts and {steps[0]} of {steps[1]} steps were "
        "found. It was filtered or edited; read the original"
    )


@dataclass
class Part:
    """Rollouts that share a layout.

    ``numbers`` are theirs in the file, ``starts`` (ns) when they begin to play, ``lengths`` their entries, ``executed``
    the executed steps of each decision where frames past a stop have a topic of their own (None: as the step messages
    say), ``done`` the entries that were found, ``damaged`` the numbers of rollouts that lack some or all of theirs.
    """

    layout: Layout
    prefix: str
    batch: list[int]
    steps: int
    numbers: list[int]
    starts: list[int]
    lengths: list[int]
    texts: list[tuple[_Path, list[str]]]
    executed: list[list[int]] | None
    file: Path
    values: dict[_Path, Tensor] = field(default_factory=dict)  # by (stored, *key), see :meth:`decode`
    done: int = 0
    damaged: list[int] = field(default_factory=list)

    @property
    def rows(self) -> int:
        return len(self.lengths)

    def select(self, keep: list[int]) -> Part:
        """The rollouts with these places, with what is decoded of them, as one flat batch."""
        pick = lambda values: [values[index] for index in keep]  # noqa: E731
        return Part(
            self.layout,
            self.prefix,
            [len(keep)],
            self.steps,
            pick(self.numbers),
            pick(self.starts),
            pick(self.lengths),
            [(path, pick(words)) for path, words in self.texts],
            None if self.executed is None else pick(self.executed),
            self.file,
            {key: value[keep] for key, value in self.values.items()},
        )

    def decode(self, found: dict[int, Found], complete: bool, wanted: Callable[[_Path], bool]) -> None:
        """Messages -> values by key: [R, T + 1, ...] for chained entries, [R, T, ...] for ``root`` and ``next`` ones.

        Of a file that is not ``complete``, a rollout is what comes before its first missing message.

        Raises:
            ValueError: if messages are missing although the file is complete, or of another type.
        """
        rollouts = [found.get(number, {}) for number in self.numbers]
        steps = [messages.get(f"{self.prefix}/step", []) for messages in rollouts]
        resets = [messages.get(f"{self.prefix}/reset", []) for messages in rollouts]
        have = [len(each) for each in steps]
        if complete and (have != self.lengths or any(len(each) != 1 for each in resets)):
            raise lacks_messages(self.file, (sum(map(bool, resets)), self.rows), (sum(have), sum(self.lengths)))
        if not complete:
            have = [self._leading(*each) for each in zip(steps, resets, self.starts, self.lengths, strict=True)]
        self._decode_numbers(resets, steps, have, wanted)
        for topic in sorted({e.topic for e in self.layout.images if self._needed(e, wanted)}):
            self._decode_images(topic, rollouts, have, complete)
        for entry in self.layout.images:
            if entry.stored == "last_of_frames" and wanted(entry.key):
                self._fill_last(entry, have)
        self.done = sum(have)
        self.damaged = [n for n, had, length in zip(self.numbers, have, self.lengths, strict=True) if had < length]
        if not complete:
            self._shorten(have)

    def _leading(self, steps: list, resets: list, start: int, length: int) -> int:
        """How many steps are there before the first one that is missing."""
        if not resets:
            return 0
        period = self.layout.steps_per_entry * PERIOD_NS
        expected = (start + (step + 1) * period for step in range(length))
        return next((at for at, (m, t) in enumerate(zip(steps, expected, strict=False)) if m[0] != t), len(steps))

    def _shorten(self, have: list[int]) -> None:
        """Keeps what an incomplete file still has: leading groups with at least one step."""
        last = [index for index, length in enumerate(have) if length]
        count = last[-1] + 1 if last else 0
        group = math.prod(self.batch[1:]) if self.batch else 1
        count = -(-count // group) * group
        have = (have + [0] * count)[:count]
        for key, value in self.values.items():
            extra = int(value.shape[1] > self.steps)
            value = value[:count]
            for row, length in enumerate(have):
                value[row, length + extra * bool(length) :] = 0
            self.values[key] = value
        self.lengths = have
        self.numbers, self.starts = self.numbers[:count], self.starts[:count]
        self.texts = [(path, words[:count]) for path, words in self.texts]
        self.batch = [count // group, *self.batch[1:]]

    # --------------------------------------------------------------------------------------------- numbers

    def _decode_numbers(self, resets: list, steps: list, have: list[int], wanted: Callable[[_Path], bool]) -> None:
        layout, rows = self.layout, self.rows
        begun = [row for row, messages in enumerate(resets) if messages]
        first = layout.reset_message().unpack([resets[row][0][1] for row in begun])[1:]
        flat = [data for each, count in zip(steps, have, strict=True) for _, data in each[:count]]
        values = layout.step_message().unpack(flat)
        steps_of = np.concatenate([np.arange(count) for count in have] or [np.zeros(0, np.int64)])
        if len(flat) and (np.ascontiguousarray(values[1]).view(np.int64)[:, 0] != steps_of).any():
            raise ValueError(f"the steps in {self.file} are out of order")
        row, step = torch.from_numpy(np.repeat(np.arange(rows), have)), torch.from_numpy(steps_of)
        start = {e.key: raw for e, raw in zip((e for e in layout.numbers if e.chained), first, strict=True)}
        for entry, raw in zip(layout.numbers, values[2:], strict=True):
            if not wanted(entry.key) and entry.key != (STEP_MASK,):
                continue
            extra = int(entry.chained)
            out = torch.zeros(rows, self.steps + extra, *entry.shape, dtype=entry.torch_dtype)
            if extra and begun:
                out[begun, 0] = from_bytes(start[entry.key], entry)
            if len(step):
                out[row, step + extra] = from_bytes(raw, entry)
            self.values[(entry.stored, *entry.key)] = out

    # --------------------------------------------------------------------------------------------- images

    def _needed(self, entry: Entry, wanted: Callable[[_Path], bool]) -> bool:
        other = same_camera(entry.key)
        return wanted(entry.key) or (other is not None and self.layout.splits(entry) and wanted(other))

    def _decode_images(self, topic: str, rollouts: list[Found], have: list[int], complete: bool) -> None:
        entries = [e for e in self.layout.images if e.topic == topic]
        for entry in entries:
            shape = (self.rows, self.steps + int(entry.chained), *entry.shape)
            self.values[(entry.stored, *entry.key)] = torch.zeros(*shape, dtype=torch.uint8)
        buffers = [(e, self.values[(e.stored, *e.key)].numpy()) for e in entries]
        for row, messages in enumerate(rollouts):
            seen = iter(messages.get(self.prefix + topic, []))
            late = iter(messages.get(f"{self.prefix}{topic}/after_stop", []))
            for target, past, step, time in self._slots(buffers, row, have[row]):
                message = next(late if past else seen, None)
                if message is None or (not complete and message[0] != time):
                    if complete:
                        raise ValueError(
                            f"{self.file} lacks images on {topic}: it was filtered or edited; read the original"
                        )
                    have[row] = min(have[row], step)
                    break
                _fill(target, message[1], self.file)

    def _slots(
        self, buffers: list[tuple[Entry, np.ndarray]], row: int, length: int
    ) -> Iterator[tuple[np.ndarray, bool, int, int]]:
        """Where a rollout's images of a topic go, in the order in which they were written.

        With each: whether it comes after a stop, the step that needs it, and its time.
        """
        start, period = self.starts[row], self.layout.steps_per_entry * PERIOD_NS
        for entry, buffer in buffers:
            if entry.stored in ("chained", "last_of_frames"):
                for place, image in enumerate(_each(buffer[row, 0])):
                    yield image, False, 0, start + place * PERIOD_NS
        for step in range(length):
            time = start + step * period
            for entry, buffer in buffers:
                if entry.stored == "last_of_frames":
                    continue
                images = _each(buffer[row, step + int(entry.chained)])
                executed = len(images)
                if self.layout.splits(entry):
                    executed = self._executed(row, step)
                first = time + (0 if entry.stored == "root" else PERIOD_NS)
                for place, image in enumerate(images):
                    yield image, place >= executed, step, first + place * PERIOD_NS

    def _executed(self, row: int, step: int) -> int:
        if self.executed is not None:
            return self.executed[row][step]
        return int(self._step_mask()[row, -self.steps :][step].sum())

    def _step_mask(self) -> Tensor:
        return next(v for key, v in self.values.items() if key[1:] == (STEP_MASK,) and key[0] != "root")

    def _fill_last(self, entry: Entry, have: list[int]) -> None:
        path = same_camera(entry.key)
        frames = next(v for key, v in self.values.items() if key[1:] == path and key[0] != "root")
        mask, out = self._step_mask(), self.values[(entry.stored, *entry.key)]
        for row, length in enumerate(have):
            last = mask[row, -self.steps :][:length].sum(-1) - 1
            out[row, 1 : length + 1] = frames[row, -self.steps :][torch.arange(length), last]


def _each(images: np.ndarray) -> np.ndarray:
    return images[None] if images.ndim == 3 else images


def _fill(target: np.ndarray, message: memoryview, file: Path) -> None:
    _, height, width = target.shape
    head = image_head(height, width)
    start = len(message) - 3 * height * width
    if start < len(head) or message[start - len(head) : start] != head:  # another program's order of the fields
        try:
            found_width, found_height, start = image_data(message)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error
        if (found_width, found_height) != (width, height):
            raise ValueError(
                f"{file} holds an image of {found_width} x {found_height} px where {width} x {height} was written"
            )
    pixels = np.frombuffer(message, np.uint8, count=height * width * 3, offset=start)
    for channel, plane in enumerate(target):
        plane[:] = pixels[channel::3].reshape(height, width)
