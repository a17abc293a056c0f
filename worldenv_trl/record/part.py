"""One write of a recording: from its messages back to tensors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from worldenv_trl.keys import FRAMES, STEP_MASK
from worldenv_trl.record.layout import Entry, Layout, from_bytes
from worldenv_trl.record.protobuf import image_data

__all__ = ["Part"]


@dataclass
class Part:
    """One write: the metadata of its rollouts and, while the file is read, its messages by topic.

    ``lengths`` are the rollouts' entries, ``executed`` the executed steps of each decision where frames past a stop
    have a topic of their own, ``done`` the entries that were found.
    """

    layout: Layout
    prefix: str
    batch: list[int]
    steps: int
    lengths: list[int]
    texts: list[tuple[tuple[str, ...], list[str]]]
    executed: list[list[int]] | None
    file: Path
    messages: dict[str, list[bytes]] = field(default_factory=dict)
    values: dict[tuple[str, ...], Tensor] = field(default_factory=dict)  # by (stored, *key), see :meth:`decode`
    done: int = 0

    @property
    def rows(self) -> int:
        return len(self.lengths)

    def decode(self, complete: bool) -> None:
        """Messages -> values by key: [R, T + 1, ...] for chained entries, [R, T, ...] for ``root`` and ``next`` ones.

        Raises:
            ValueError: if messages are missing although the file is complete, or of another type.
        """
        steps = self.messages.get(f"{self.prefix}/step", [])
        resets = self.messages.get(f"{self.prefix}/reset", [])
        expected = sum(self.lengths)
        if complete and (len(steps) != expected or len(resets) != self.rows):
            raise ValueError(
                f"{self.file} lacks messages: {len(resets)} of {self.rows} rollouts and {len(steps)} of {expected} "
                "steps were found. It was filtered or edited; read the original"
            )
        started = min(len(resets), self.rows)
        left, found = len(steps), []
        for length in self.lengths[:started]:
            found.append(min(length, left))
            left -= found[-1]
        self.done = sum(found)
        if not complete:
            self._drop_unstarted(found)
        row = np.repeat(np.arange(self.rows), self.lengths)
        step = np.concatenate([np.arange(length) for length in self.lengths] or [np.zeros(0, np.int64)])
        self._decode_numbers(resets[: self.rows], steps[: self.done], row, step)
        for topic in sorted({e.topic for e in self.layout.images}):
            self._decode_images(topic, complete)
        self.messages.clear()

    def _drop_unstarted(self, found: list[int]) -> None:
        """Keeps what a truncated file still has: leading groups with at least one step."""
        have = [index for index, length in enumerate(found) if length]
        count = have[-1] + 1 if have else 0
        group = math.prod(self.batch[1:]) if self.batch else 1
        count = -(-count // group) * group
        self.lengths = (found + [0] * count)[:count]
        self.texts = [(path, words[:count]) for path, words in self.texts]
        self.batch = [count // group, *self.batch[1:]]

    def _decode_numbers(self, resets: list[bytes], steps: list[bytes], row: np.ndarray, step: np.ndarray) -> None:
        layout, rows = self.layout, self.rows
        chained = [e for e in layout.numbers if e.chained]
        first = layout.reset_message().unpack(resets)[1:]
        values = layout.step_message().unpack(steps)
        if len(steps) and (np.ascontiguousarray(values[1]).view(np.int64)[:, 0] != step).any():
            raise ValueError(f"the steps in {self.file} are out of order")
        row, step = torch.from_numpy(row), torch.from_numpy(step)
        start = {e.key: raw for e, raw in zip(chained, first, strict=True)}
        for entry, raw in zip(layout.numbers, values[2:], strict=True):
            extra = int(entry.chained)
            out = torch.zeros(rows, self.steps + extra, *entry.shape, dtype=entry.torch_dtype)
            if extra:
                out[: len(resets), 0] = from_bytes(start[entry.key], entry)
            if len(step):
                out[row, step + extra] = from_bytes(raw, entry)
            self.values[(entry.stored, *entry.key)] = out

    def _decode_images(self, topic: str, complete: bool) -> None:
        entries = [e for e in self.layout.images if e.topic == topic]
        for entry in entries:
            extra = int(entry.chained)
            out = torch.zeros(self.rows, self.steps + extra, *entry.shape, dtype=torch.uint8)
            self.values[(entry.stored, *entry.key)] = out
        messages = self.messages.get(self.prefix + topic, [])
        after_stop = iter(self.messages.get(f"{self.prefix}{topic}/after_stop", []))
        seen = iter(messages)
        for target, late in self._slots(entries):
            message = next(after_stop if late else seen, None)
            if message is None and not complete:
                break  # the next rollout of a group had not begun
            if message is None:
                raise ValueError(f"{self.file} lacks images on {topic}: it was filtered or edited; read the original")
            _fill(target, message, self.file)
        for entry in entries:
            if entry.stored == "last_of_frames":
                self._fill_last(entry)

    def _slots(self, entries: list[Entry]) -> Iterator[tuple[np.ndarray, bool]]:
        """Where the images of a topic go, in the order in which they were written; whether they come after a stop."""
        buffers = [(e, self.values[(e.stored, *e.key)].numpy()) for e in entries]
        for row, length in enumerate(self.lengths):
            for entry, buffer in buffers:
                if entry.stored in ("chained", "last_of_frames"):
                    yield from ((image, False) for image in _each(buffer[row, 0]))
            for step in range(length):
                for entry, buffer in buffers:
                    if entry.stored == "last_of_frames":
                        continue
                    images = _each(buffer[row, step + int(entry.chained)])
                    split = self.executed if entry.key == (FRAMES,) else None
                    executed = len(images) if split is None else split[row][step]
                    yield from ((image, place >= executed) for place, image in enumerate(images))

    def _fill_last(self, entry: Entry) -> None:
        frames = next(v for key, v in self.values.items() if key[1:] == (FRAMES,) and key[0] != "root")
        mask = next(v for key, v in self.values.items() if key[1:] == (STEP_MASK,) and key[0] != "root")
        out = self.values[(entry.stored, *entry.key)]
        for row, length in enumerate(self.lengths):
            last = mask[row, -self.steps :][:length].sum(-1) - 1
            out[row, 1 : length + 1] = frames[row, -self.steps :][torch.arange(length), last]


def _each(images: np.ndarray) -> np.ndarray:
    return images[None] if images.ndim == 3 else images


def _fill(target: np.ndarray, message: bytes, file: Path) -> None:
    try:
        width, height, start = image_data(message)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    if target.shape != (3, height, width):
        raise ValueError(
            f"{file} holds an image of {width} x {height} px where {target.shape[2]} x {target.shape[1]} was written"
        )
    pixels = np.frombuffer(message, np.uint8, count=height * width * 3, offset=start)
    target[:] = pixels.reshape(height, width, 3).transpose(2, 0, 1)
