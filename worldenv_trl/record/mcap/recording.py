"""The index of a recording: what it holds and where, without its messages."""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from mcap.records import Metadata
from torch import Tensor

from worldenv_trl.keys import EPISODE, ROW
from worldenv_trl.record.mcap.annotations import annotation_message
from worldenv_trl.record.mcap.encoder import PERIOD_NS
from worldenv_trl.record.mcap.layout import Entry, Layout, from_bytes
from worldenv_trl.record.mcap.part import Found, Part, lacks_messages
from worldenv_trl.record.mcap.scan import McapScan
from worldenv_trl.record.mcap.writer import FORMAT, VERSION

__all__ = ["TEXT", "Recording", "RolloutInfo"]

TEXT = "text"  # entry of a recorder's rollouts: which of the file's texts
_Path = tuple[str, ...]
_INDEX = Entry(("step",), "root", "int64", (1,))


@dataclass(frozen=True)
class RolloutInfo:
    """One rollout of a file: its number there, when it begins to play (s), its entries, what was asked for.

    ``row`` and ``episode`` tell the env's row it ran in and how many rollouts that row had begun before; they are None
    for rollouts that were written when they were finished.
    """

    file: Path
    number: int
    start: float
    length: int
    instruction: str
    row: int | None = None
    episode: int | None = None


class Recording:
    """Reads a file's metadata and where its rollouts are; :meth:`parts` opens the messages that are needed.

    Raises:
        ValueError: for a file that is no MCAP, not written by this package, or by a later release of it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.scan = path, McapScan(path)
        records = self.scan.metadata
        version = next((record.metadata.get("version", "0") for record in records if record.name == FORMAT), None)
        lost = version is None and any(record.name.startswith(f"{FORMAT}.") for record in records)
        if lost:
            version = str(VERSION)
        if version is None:
            if not self.scan.intact:
                raise ValueError(f"{path} holds no worldenv_trl rollouts any more: it {self.scan.losses[0]}")
            raise ValueError(f"{path} holds no worldenv_trl rollouts: it was written by another program")
        self.version = int(version) if version.isdigit() else 0
        if not 1 <= self.version <= VERSION:
            raise ValueError(
                f"{path} has format version {version}, this release reads up to {VERSION}: update worldenv_trl"
            )
        self._one_camera = lost or self.version < 3  # frames were one tensor
        self.metadata: dict[str, Any] = {}
        self.written: list[Part] = []
        self.streams: list[tuple[Layout, str]] = []
        self._lengths: list[int] = []  # of a recorder's rollouts, if it was closed
        self._layouts: list[Layout] = []
        self._texts: list[list] = []
        self._annotations: dict[str, Layout] = {}
        self._time = self._number = 0
        self.repaired = False
        self.damaged: set[int] = set()  # rollouts that lack steps, as far as :meth:`parts` has seen
        for record in records:
            self._note(record)

    def _note(self, record: Metadata) -> None:
        kind = record.name.removeprefix(FORMAT + ".")
        if record.name == "metadata":
            self.metadata = self._parsed(record.metadata)
        if kind == record.name:
            return
        try:
            value = json.loads(record.metadata["json"])
            if kind == "layout":
                self._layouts.append(Layout.from_json(value, self._one_camera))
            elif kind == "write":
                self._note_write(value)
            elif kind == "stream":
                self.streams.append((Layout.from_json(value["layout"], self._one_camera), value["prefix"]))
            elif kind == "lengths":
                self._lengths = list(value)
            elif kind == "texts":
                self._texts.append([[tuple(path), said] for path, said in value])
            elif kind == "annotation":
                self._annotations[value["topic"]] = Layout.from_json(value["layout"])
            elif kind == "repaired":
                self.repaired = True
        except (json.JSONDecodeError, KeyError, IndexError, TypeError, ValueError) as error:
            why = "" if self.scan.intact else f" (it {self.scan.losses[0]})"
            raise ValueError(
                f"{self.path} describes its rollouts in a way this release does not know{why}: {error!r}"
            ) from error

    def _parsed(self, values: dict[str, str]) -> dict[str, Any]:
        try:
            return {key: json.loads(value) for key, value in values.items()}
        except json.JSONDecodeError as error:
            raise ValueError(
                f"{self.path} holds no worldenv_trl rollouts: its metadata is not JSON ({error})"
            ) from error

    def _note_write(self, record: dict[str, Any]) -> None:
        index = record["layout"]
        layout, lengths = self._layouts[index], record["lengths"]
        # Where an earlier write is missing, counting would go wrong; files of format 1 say neither.
        self._time = record.get("start", self._time)
        self._number = record.get("first", self._number)
        starts = []
        for length in lengths:
            starts.append(self._time)
            self._time += (length * layout.steps_per_entry + 1) * PERIOD_NS
        numbers = list(range(self._number, self._number + len(lengths)))
        self._number += len(lengths)
        self.written.append(
            Part(
                layout=layout,
                prefix=f"/layout_{index + 1}" if index else "",
                batch=record["batch"],
                steps=record["steps"],
                numbers=numbers,
                starts=starts,
                lengths=lengths,
                texts=[(tuple(path), words) for path, words in record["texts"]],
                executed=record.get("executed"),
                file=self.path,
            )
        )

    # --------------------------------------------------------------------------------------------- messages

    def parts(
        self, keep: Callable[[int, int, int], bool] | None = None, wanted: Callable[[_Path], bool] = lambda _: True
    ) -> list[Part]:
        """The rollouts, decoded.

        Args:
            keep: of which rollouts, by number, start and end (ns); None: of all.
            wanted: of which entries, by path without ``next``.
        """
        written = self.written
        if keep is not None:
            written = [part.select(self._kept(part, keep)) for part in written]
        written = [part for part in written if part.rows or keep is None]
        spans = None
        if not self.streams:
            spans = sorted((part.starts[i], _end(part, i)) for part in written for i in range(part.rows))
        found = self._found(spans)
        streamed = [part for layout, prefix in self.streams for part in self._streamed(layout, prefix, found)]
        if keep is not None:
            streamed = [part.select(self._kept(part, keep)) for part in streamed]
        self._check_announced(streamed, keep is None)
        parts = [part for part in (*written, *streamed) if part.rows]
        self.damaged = set()
        if self.streams and keep is None:  # where a recorder was not closed, how many there were is not known
            count = max(len(self._lengths), max(found, default=-1))
            whole = {n: length for part in streamed for n, length in zip(part.numbers, part.lengths, strict=True)}
            lengths = dict(enumerate(self._lengths))
            self.damaged = {n for n in range(count) if n not in whole or whole[n] < lengths.get(n, 0)}
        for part in parts:
            part.decode(found, self.scan.intact and not self.repaired, wanted)
            self._annotate(part, found, wanted)
            self.damaged |= set(part.damaged)
        return [part for part in parts if part.rows]

    def _check_announced(self, streamed: list[Part], everything: bool) -> None:
        """Raises ``ValueError`` if a whole file lacks steps that its recorder says it has written."""
        if not self._lengths or not self.scan.intact or self.repaired:
            return
        have = {n: length for part in streamed for n, length in zip(part.numbers, part.lengths, strict=True)}
        said = {n: self._lengths[n] for n in (range(len(self._lengths)) if everything else have)}
        if have != said:
            raise lacks_messages(self.path, (len(have), len(said)), (sum(have.values()), sum(said.values())))

    @staticmethod
    def _kept(part: Part, keep: Callable[[int, int, int], bool]) -> list[int]:
        return [i for i in range(part.rows) if keep(part.numbers[i], part.starts[i], _end(part, i))]

    def _found(self, spans: list[tuple[int, int]] | None) -> dict[int, Found]:
        """The messages of each rollout by topic; of chunks that overlap with ``spans`` (ns) only."""
        found: dict[int, Found] = {}
        starts = [start for part in self.written for start in part.starts]
        numbers = [number for part in self.written for number in part.numbers]
        for chunk in self.scan.chunks:
            # Without an index a chunk's times are not to be trusted, nor are the channels known before it is opened.
            if spans is not None and self.scan.indexed and not _overlaps(spans, chunk.start_time, chunk.end_time):
                continue
            for channel, number, time, data in self.scan.messages(chunk):
                if self.version == 1:  # its messages do not name their rollout, but rollouts do not overlap in time
                    place = bisect_right(starts, time) - 1
                    number = numbers[place] if place >= 0 else -1
                topic = self.scan.channels[channel].topic if channel in self.scan.channels else ""
                found.setdefault(number, {}).setdefault(topic, []).append((time, data))
        return found

    def _streamed(self, layout: Layout, prefix: str, found: dict[int, Found]) -> list[Part]:
        """The rollouts of a recorder as one part: how many there are, and how long, follows from their messages."""
        numbers = sorted(
            n for n, topics in found.items() if topics.get(f"{prefix}/reset") and f"{prefix}/step" in topics
        )
        if not numbers:
            return []
        lengths = [len(found[number][f"{prefix}/step"]) for number in numbers]
        place = next(i for i, e in enumerate(layout.numbers) if e.key == (TEXT,))
        unpack = layout.step_message().unpack
        first = unpack([found[number][f"{prefix}/step"][0][1] for number in numbers])[2:]
        said = from_bytes(first[place], layout.numbers[place]).flatten().tolist()
        texts = [(path, [dict(map(tuple, self._texts[index]))[path] for index in said]) for path in layout.texts]
        return [
            Part(
                layout=layout,
                prefix=prefix,
                batch=[len(numbers)],
                steps=max(lengths),
                numbers=numbers,
                starts=[found[number][f"{prefix}/reset"][0][0] for number in numbers],
                lengths=lengths,
                texts=texts,
                executed=None,
                file=self.path,
            )
        ]

    def _annotate(self, part: Part, found: dict[int, Found], wanted: Callable[[_Path], bool]) -> None:
        for topic, layout in self._annotations.items():
            message = annotation_message(layout)
            rows, messages = [], []
            for row, number in enumerate(part.numbers):
                said = found.get(number, {}).get(topic, [])
                rows += [row] * len(said)
                messages += [data for _, data in said]
            _, step, *raw = message.unpack(messages)
            of = torch.tensor(rows, dtype=torch.int64)
            at = from_bytes(step, _INDEX).flatten() if messages else torch.zeros(0, dtype=torch.int64)
            inside = at < torch.tensor(part.lengths)[of] if messages else at.bool()
            for entry, data in zip(layout.numbers, raw, strict=True):
                if not wanted(entry.key):
                    continue
                key = (entry.stored, *entry.key)
                out = part.values.get(key)
                if out is None or out.shape[2:] != entry.shape or out.dtype != entry.torch_dtype:
                    out = _unknown(part, entry.shape, entry.torch_dtype)
                if messages:
                    out[of[inside], at[inside]] = from_bytes(data, entry)[inside]
                part.values[key] = out

    def infos(self, parts: Iterable[Part]) -> list[RolloutInfo]:
        """What is known of each rollout."""
        infos = []
        for part in parts:
            said = dict(part.texts)
            words = said.get(("language_instruction",)) or said.get(("next", "language_instruction"))
            row, episode = part.values.get(("root", ROW)), part.values.get(("root", EPISODE))
            for place in range(part.rows):
                infos.append(
                    RolloutInfo(
                        file=self.path,
                        number=part.numbers[place],
                        start=part.starts[place] / 1e9,
                        length=part.lengths[place],
                        instruction=words[place] if words else "",
                        row=None if row is None else int(row[place, 0]),
                        episode=None if episode is None else int(episode[place, 0]),
                    )
                )
        return infos

    def entries(self) -> set[_Path]:
        """The paths of all entries, as in the TensorDict."""
        layouts = [part.layout for part in self.written] + [layout for layout, _ in self.streams]
        found = {path for layout in layouts for path in layout.texts}
        for layout in (*layouts, *self._annotations.values()):
            for entry in (*layout.images, *layout.numbers):
                found |= {entry.key} if entry.stored != "next" else set()
                found |= {("next", *entry.key)} if entry.stored != "root" else set()
        return found - {(TEXT,)}

    def count(self) -> int:
        """How many rollouts were recorded; those that are damaged have their numbers, too."""
        if not self.streams:
            return self._number
        if self._lengths:
            return len(self._lengths)
        return 1 + max(self.numbers(), default=-1)

    def numbers(self) -> list[int]:
        """The numbers of the rollouts of which something is left."""
        if not self.streams:
            return list(range(self._number))
        return sorted(n for part in self.parts(wanted=lambda _: False) for n in part.numbers)

    def expected(self, keep: Callable[[int, int, int], bool] | None = None) -> int:
        """How many entries the chosen rollouts had, as far as the file says."""
        said = [pair for part in self.written for pair in zip(part.numbers, part.lengths, strict=True)]
        said += enumerate(self._lengths)
        return sum(length for number, length in said if keep is None or keep(number, 0, 2**62))

    def warning(self, parts: Iterable[Part], expected: int) -> str:
        """What is missing, if anything, when ``parts`` of ``expected`` entries were read."""
        if self.scan.intact:
            return ""
        lost = "; it ".join(dict.fromkeys(self.scan.losses))
        done = sum(part.done for part in parts)
        said = f"{self.path} {lost}: {done} complete steps were read"
        if self.damaged:
            most = f"at least {expected - done} more" if expected > done else "others"
            return (
                f"{said}, {most} of rollout{'s' * (len(self.damaged) > 1)} {_ranges(sorted(self.damaged))} are missing"
            )
        known = self.written or self._lengths
        return f"{said}, {'all that it announces' if known else 'and none before them is missing'}"


def _ranges(numbers: list[int]) -> str:
    """``3 to 5, 8``."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)


def _end(part: Part, index: int) -> int:
    return part.starts[index] + part.lengths[index] * part.layout.steps_per_entry * PERIOD_NS


def _overlaps(spans: list[tuple[int, int]], start: int, end: int) -> bool:
    place = bisect_right(spans, (end, math.inf)) - 1
    return any(last >= start for _, last in spans[max(place - 1, 0) : place + 1])


def _unknown(part: Part, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    out = torch.zeros(part.rows, part.steps, *shape, dtype=dtype)
    if dtype.is_floating_point:
        for row, length in enumerate(part.lengths):
            out[row, :length] = torch.nan
    return out
