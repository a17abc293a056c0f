"""Finished rollouts to MCAP."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor

from worldenv_trl.keys import INSTRUCTION, STEP_MASK, SUCCESS
from worldenv_trl.record.mcap.annotations import Annotator
from worldenv_trl.record.mcap.encoder import PERIOD_NS, RolloutEncoder
from worldenv_trl.record.mcap.file import McapFile, still_holds
from worldenv_trl.record.mcap.layout import Layout, executed_entries, leaves

__all__ = ["FORMAT", "VERSION", "RolloutWriter", "open_file"]

FORMAT, VERSION = "worldenv_trl.rollouts", 3  # 3: frames by camera
_FIRST_GUESS = 0.5  # compressed size over raw size, before anything was measured
_MEASURED = 16 * 2**20  # bytes
_STEPS_AT_ONCE = 8  # of a file that is cut off, so many may be lost


def open_file(
    path: str | os.PathLike,
    metadata: Mapping[str, Any] | None,
    attachments: Mapping[str, bytes | str | os.PathLike] | None,
    overwrite: bool,
) -> McapFile:
    """A file of this format that holds its metadata and attachments already; raises as :class:`RolloutWriter`."""
    try:
        described = {str(key): json.dumps(value) for key, value in (metadata or {}).items()}
    except TypeError as error:
        raise ValueError(f"metadata must hold plain values (text, numbers, lists, dicts): {error}") from error
    files = {name: _contents(name, value) for name, value in (attachments or {}).items()}
    file = McapFile(path, overwrite=overwrite)
    try:
        file.require_space(sum(map(len, files.values())))
        file.write_metadata(FORMAT, {"version": str(VERSION)})
        if described:
            file.write_metadata("metadata", described)
        for name, data in files.items():
            file.attach(name, data)
        file.flush()
    except OSError:
        file.abort()
        raise
    return file


class RolloutWriter:
    """Writes TorchRL rollouts to one MCAP file that Foxglove and Rerun open and :func:`read_rollouts` reads back.

    Rollouts follow each other in time at 20 steps a second: each camera's images, with every frame that its decisions
    produced, as ``foxglove.RawImage`` on ``/observation/<entry>``, one ``worldenv_trl.Step`` message per entry on
    ``/step`` (a field per key, so they can be plotted), the first values on ``/reset``, the hand as ``PoseInFrame`` on
    ``/hand``, the instruction as ``Log`` on ``/instruction``. Everything needed to rebuild the TensorDict is metadata
    written before the messages.

    The file appears under its name when the writer is closed. Until then, and after an exception, what was written is
    in ``<name>.partial.mcap``, which :func:`read_rollouts` opens when named. What :meth:`write` has written when it
    returns survives the death of the process.

    Args:
        path: ends in ``.mcap``; folders are created.

    Keyword Args:
        metadata: plain values (strings, numbers, lists, dicts), for instance ``{"tasks": [...], "seed": 0}``. ``task``
            or ``tasks`` names the tasks for ``read_rollouts(path, task=...)``, ``task_ids`` their numbers in
            ``task_id`` where these are not 0, 1, ... :func:`~worldenv_trl.record.provenance` makes metadata and
            attachments of env, models, settings and versions.
        attachments: name -> bytes, text or the path of a file.
        overwrite: replace an existing file, or an unfinished one of that name.

    Raises:
        FileExistsError: if the file, or an unfinished one of that name, exists and ``overwrite`` is False; if another
            writer is at work on it.
        ValueError: for another suffix, or metadata that is not plain.
        OSError: if the disk is full, from any method; the partial file keeps what is complete.

    Examples:
        >>> import tempfile
        >>> from worldenv_trl.envs import TabletopEnv
        >>> from worldenv_trl.record import read_rollouts
        >>> env = TabletopEnv("starter/open_the_top_drawer", 2, seed=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with RolloutWriter(f"{folder}/demo.mcap", metadata={"task": "starter/open_the_top_drawer"}) as writer:
        ...         numbers = writer.write(env.rollout(5))
        ...     rollouts = read_rollouts(folder, task="starter/open_the_top_drawer", keys=["action", "observation"])
        >>> numbers, rollouts["observation", "image"].shape
        ([0, 1], torch.Size([2, 5, 3, 64, 64]))
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        metadata: Mapping[str, Any] | None = None,
        attachments: Mapping[str, bytes | str | os.PathLike] | None = None,
        overwrite: bool = False,
    ) -> None:
        self._begin(path, open_file(path, metadata, attachments, overwrite))

    @classmethod
    def resumed(cls, path: str | os.PathLike, state: Mapping[str, Any]) -> Self:
        """Continues a recording, finished or not, as its writer would have after it gave ``state``: what was written
        later goes.

        Args:
            path: of the recording.
            state: of :meth:`state_dict`.

        Raises:
            ValueError: if what was written by then is no longer there, bit for bit (:meth:`still_holds`).
            FileExistsError: if another writer is at work on it.
        """
        writer = cls.__new__(cls)
        writer._begin(path, McapFile(path, state=state))
        return writer

    still_holds = staticmethod(still_holds)

    def state_dict(self) -> dict[str, Any]:
        """What :meth:`resumed` continues from; what was written by now is on the disk, as far as a program can see."""
        if self._file.closed:
            raise ValueError(f"the writer of {self.path} is closed")
        return self._file.state_dict()

    def _begin(self, path: str | os.PathLike, file: McapFile) -> None:
        """With what ``file`` says of itself."""
        self.path, self._file = Path(path), file
        self._encoders: list[RolloutEncoder] = []
        self._raw_bytes = 0
        self._starts: list[tuple[int, int, int]] = []  # of each rollout: time (ns), its layout, its entries
        self._time = 0
        self._writing = False  # half of a write must not look complete
        annotated: list[Layout] = []
        for name, values in file.metadata:
            kind = name.removeprefix(f"{FORMAT}.")
            if kind not in ("layout", "write", "annotation"):
                continue
            record = json.loads(values["json"])
            if kind == "layout":
                self._add_encoder(Layout.from_json(record))
            elif kind == "annotation":
                annotated.append(Layout.from_json(record["layout"]))
            else:
                for length in record["lengths"]:
                    self._note_rollout(record["layout"], length)
                self._raw_bytes += _raw_bytes(self._encoders[record["layout"]].layout, sum(record["lengths"]))
        self._annotator = Annotator(file, f"{FORMAT}.annotation", self._length, self._step_time, annotated)

    def write(self, rollouts: TensorDictBase) -> list[int]:
        """Appends rollouts ``[*B, T]`` with their root and next entries; one action or one decision per entry.

        Only what ``("collector", "mask")`` marks is stored (without a mask: up to the first ``done``). Text must be
        constant within a rollout. Writes may differ in B and T.

        Returns:
            The numbers of these rollouts in the file, for :meth:`annotate`.

        Raises:
            ValueError: for a writer that is closed, or entries that are neither tensors nor text.
            OSError: before anything of ``rollouts`` is written, if the disk seems too small for it.
        """
        if self._file.closed:
            raise ValueError(f"the writer of {self.path} is closed")
        if rollouts.ndim < 1 or 0 in rollouts.shape:
            raise ValueError(f"rollouts must be [*B, T] with at least one entry, got {list(rollouts.shape)}")
        tensors, texts = leaves(rollouts)
        valid = executed_entries(rollouts)
        flat = {key: value.reshape(*valid.shape, *value.shape[rollouts.ndim :]) for key, value in tensors.items()}
        layout = Layout.of(flat, texts, valid)
        lengths = valid.sum(-1)
        texts = {path: _row_texts(path, value, valid.shape, lengths) for path, value in texts.items()}
        raw = _raw_bytes(layout, int(lengths.sum()))
        self._file.require_space(int(raw * self._compression()))

        index = self._layout_index(layout)
        first = len(self._starts)
        record = {
            "layout": index,
            "batch": list(rollouts.shape[:-1]),
            "steps": rollouts.shape[-1],
            "lengths": lengths.tolist(),
            "texts": [[list(path), texts[path]] for path in layout.texts],
            "first": first,
            "start": self._time,
        }
        if layout.splits_frames:
            executed = flat["next", STEP_MASK].sum(-1)
            record["executed"] = [executed[row, :length].tolist() for row, length in enumerate(lengths.tolist())]
        self._writing = True
        self._file.write_metadata(f"{FORMAT}.write", {"json": json.dumps(record)})
        said = texts.get((INSTRUCTION,)) or texts.get(("next", INSTRUCTION))
        for row, length in enumerate(lengths.tolist()):
            self._write_row(index, {key: value[row] for key, value in flat.items()}, length)
            if said:
                self._encoders[index].say(first + row, self._time - PERIOD_NS, said[row], _outcome(flat, row, length))
            self._file.end_chunk()
            self._file.flush_if_due()
        self._raw_bytes += raw
        self._file.flush()
        self._writing = False
        return list(range(first, len(self._starts)))

    def _layout_index(self, layout: Layout) -> int:
        layouts = [encoder.layout for encoder in self._encoders]
        if layout not in layouts:
            self._file.write_metadata(f"{FORMAT}.layout", {"json": json.dumps(layout.to_json())})
            self._add_encoder(layout)
            return len(layouts)
        return layouts.index(layout)

    def _add_encoder(self, layout: Layout) -> None:
        prefix = f"/layout_{len(self._encoders) + 1}" if self._encoders else ""
        self._encoders.append(RolloutEncoder(self._file, layout, prefix))

    def _write_row(self, index: int, row: dict[tuple[str, ...], Tensor], length: int) -> None:
        """One rollout: its values [T, ...] by path."""
        encoder, number, start = self._encoders[index], len(self._starts), self._time
        encoder.reset([number], [start], {key: value[:1] for key, value in row.items()})
        for begin in range(0, length, _STEPS_AT_ONCE):
            steps = range(begin, min(begin + _STEPS_AT_ONCE, length))
            values = {key: value[begin : steps.stop] for key, value in row.items()}
            encoder.steps([number] * len(steps), list(steps), [start] * len(steps), values)
        self._note_rollout(index, length)

    def _note_rollout(self, index: int, length: int) -> None:
        self._starts.append((self._time, index, length))
        self._time += self._encoders[index].duration(length)

    def _length(self, number: int) -> int:
        if not 0 <= number < len(self._starts):
            raise KeyError(number)
        return self._starts[number][2]

    def _step_time(self, number: int, step: int) -> int:
        start, index, _ = self._starts[number]
        return start + (step + 1) * self._encoders[index].layout.steps_per_entry * PERIOD_NS

    def annotate(self, entries: TensorDictBase, rollouts: Sequence[int] | None = None) -> None:
        """Adds what became known later (advantages, ratios, clip flags) to rollouts that were written before.

        Args:
            entries: [*B, T], one entry for each of the rollouts' entries, as they were written.
            rollouts: their numbers; by default the last ones.

        :func:`read_rollouts` gives the entries as if they had been written with the rollouts; where there are none,
        they are NaN (zero for integers and flags). A later annotation replaces an earlier one.

        Raises:
            ValueError: for other numbers of rollouts or steps than were written, text or images.
        """
        if rollouts is None:
            count = int(np.prod(entries.shape[:-1], dtype=np.int64))
            rollouts = range(len(self._starts) - count, len(self._starts))
        self._annotator.write(entries, rollouts)

    def flush(self) -> None:
        """Hands everything written to the operating system; :meth:`write` and :meth:`annotate` do."""
        self._file.flush()

    def _compression(self) -> float:
        """Expected size over raw size, with a margin."""
        if self._raw_bytes < _MEASURED:
            return _FIRST_GUESS
        return 1.5 * (self._file.size + _MEASURED // 32) / self._raw_bytes

    def close(self) -> None:
        """Finishes the file and gives it its name.

        Raises:
            OSError: if the file could not be completed; what was written stays in the partial file.
        """
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exception_type: type | None, *_: object) -> None:
        if exception_type is None:
            self._file.close()
        elif self._writing and not self._file.closed:
            self._file.flush()
            self._file.abort()
        else:
            self._file.close_partial()


def _raw_bytes(layout: Layout, entries: int) -> int:
    return entries * sum(e.nbytes for e in (*layout.images, *layout.numbers))


def _outcome(flat: dict[tuple[str, ...], Tensor], row: int, length: int) -> str:
    success = flat.get(("next", SUCCESS))
    if success is None or not length:
        return ""
    return "reached" if bool(success[row, :length].any()) else "not reached"


def _contents(name: str, value: bytes | str | os.PathLike) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, os.PathLike):
        path = Path(value)
        if not path.is_file():
            raise FileNotFoundError(f"attachment {name!r}: there is no file {path}")
        return path.read_bytes()
    return str(value).encode()


def _row_texts(path: tuple[str, ...], value: Any, shape: Sequence[int], lengths: Tensor) -> list[str]:
    """One text for each rollout, from nested lists [*B, T]."""
    rows, steps = shape
    words = [value] * (rows * steps) if isinstance(value, str) else _flatten(value)
    if len(words) != rows * steps or any(not isinstance(word, str) for word in words):
        raise ValueError(f"entry {path} must hold one text for each entry of the rollouts")
    out = []
    for row, length in enumerate(lengths.tolist()):
        said = words[row * steps : row * steps + max(length, 1)]
        if any(word != said[0] for word in said):
            raise ValueError(f"entry {path} changes within rollout {row}: text must be constant within a rollout")
        out.append(said[0])
    return out


def _flatten(value: Any) -> list:
    return [word for part in value for word in _flatten(part)] if isinstance(value, list) else [value]
