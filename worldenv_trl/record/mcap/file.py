"""One MCAP file while it is written: under another name until it is complete, locked, every error the caller's."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
import time
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.records import Metadata

from worldenv_trl.record.mcap.index import HEAD, parsed
from worldenv_trl.record.mcap.records import McapWriter
from worldenv_trl.record.mcap.scan import METADATA_COPY

__all__ = ["PARTIAL_SUFFIX", "REPAIRED_SUFFIX", "McapFile", "check_target", "still_holds"]

PARTIAL_SUFFIX, REPAIRED_SUFFIX = ".partial.mcap", ".repaired.mcap"
FLUSH_SECONDS = 0.5
_CHUNK_BYTES = 4 * 2**20  # at most: rollouts have chunks of their own
_RESERVE = 65536  # bytes that the end of a file needs

_BUSY = "{} is being written by another writer: choose another path"
_UNFINISHED = "an unfinished recording is in {}: repair it with recipes/repair.py, or pass overwrite=True to replace it"
_HINTS = {
    errno.ENOSPC: ": the disk is full, make room",
    errno.EDQUOT: ": your share of the disk is used up, make room",
    errno.EFBIG: ": files may not become larger here (ulimit -f), raise the limit or record less into one file",
}


def check_target(path: Path, overwrite: bool) -> Path:
    """Raises what :class:`McapFile` would raise for this path now; returns where the unfinished file will be."""
    if path.suffix != ".mcap" or path.name.endswith(PARTIAL_SUFFIX):
        raise ValueError(f"path must end in .mcap (not {PARTIAL_SUFFIX}), got {path}")
    _check_free(path, overwrite)
    partial = path.with_name(path.stem + PARTIAL_SUFFIX)
    if partial.exists():
        with open(partial, "rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except OSError as error:
                raise FileExistsError(_BUSY.format(path)) from error
            if not overwrite and os.fstat(file.fileno()).st_size:
                raise FileExistsError(_UNFINISHED.format(partial))
    return partial


def _check_free(path: Path, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: pass overwrite=True to replace it")


def still_holds(path: str | os.PathLike, state: Mapping[str, Any]) -> bool:
    """Whether a file, finished or not, begins with what was in it when :meth:`McapFile.state_dict` gave ``state``."""
    left, crc = int(state["size"]), 0
    try:
        with open(_found(Path(path)), "rb") as file:
            while left and (data := file.read(min(left, 2**20))):
                left, crc = left - len(data), zlib.crc32(data, crc)
    except FileNotFoundError:
        return False
    return not left and crc == state["crc"]


def _found(path: Path) -> Path:
    """Where the bytes of a file are: under the name of an unfinished one, if there is such."""
    partial = path.with_name(path.stem + PARTIAL_SUFFIX)
    return partial if partial.exists() else path


class McapFile:
    """Writes ``<name>.partial.mcap`` and gives it its name when it is complete.

    Everything before the last :meth:`flush` survives the death of the process; :meth:`flush_if_due` flushes when the
    last flush is :data:`FLUSH_SECONDS` old.

    With a ``state`` of :meth:`state_dict` it goes on from there: what was written after it goes, finished or not.

    Raises:
        ValueError: for a path with another suffix, or a ``state`` whose bytes are no longer there.
        FileExistsError: if the file, or an unfinished one of that name, exists and ``overwrite`` is False; if another
            writer is at work on it.
        OSError: from any method, when the disk is full; what is complete stays in the partial file.
    """

    def __init__(
        self, path: str | os.PathLike, *, overwrite: bool = False, state: Mapping[str, Any] | None = None
    ) -> None:
        self.path, self._overwrite = Path(path), overwrite or state is not None
        self.partial = check_target(self.path, self._overwrite)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if state is not None and not still_holds(self.path, state):
            raise ValueError(f"{_found(self.path)} is cut short, damaged or gone: it can not be continued")
        if state is not None and not self.partial.exists():
            os.replace(self.path, self.partial)  # it was finished, its writer's work was not
        self._file = self._open_locked(0 if state is None else int(state["size"]))
        self.closed = False
        self._writer = McapWriter(self._file, _CHUNK_BYTES)
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._channels: dict[str, int] = {}
        self._metadata: list[tuple[str, dict[str, str]]] = []
        self._metadata_bytes = 0
        if state is not None:
            self._resume(state)
            return
        self._call(self._writer.start, "worldenv_trl")
        self.flush()

    def _resume(self, state: Mapping[str, Any]) -> None:
        self._writer.resume(bytes(state["index"]), int(state["crc"]))
        self._schemas, self._channels = self._writer.schemas, self._writer.channels
        with open(self.partial, "rb") as file:
            for place in self._writer.metadata:
                file.seek(place.offset)
                record = parsed(Metadata, file.read(place.length)[HEAD.size :])
                assert isinstance(record, Metadata)  # these bytes have the checksum of the state
                self._note(record.name, record.metadata)
        self._flushed = time.monotonic()

    def state_dict(self) -> dict[str, Any]:
        """From where another one, given it as ``state``, writes on. What was written is on the disk by then."""
        self.flush()
        self._call(os.fsync, self._file.fileno())
        index = np.frombuffer(self._call(self._writer.index), np.uint8)
        return {"size": self._file.tell(), "crc": self._writer.crc, "index": index}

    @property
    def metadata(self) -> list[tuple[str, dict[str, str]]]:
        """What :meth:`write_metadata` was given, in order."""
        return list(self._metadata)

    def _open_locked(self, size: int) -> BinaryIO:
        """The partial file, of which ``size`` bytes are kept."""
        while True:
            known = self.partial.exists()
            file = open(self.partial, "ab")  # noqa: SIM115 - closed by close() or abort(); "a": nothing is lost yet
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                file.close()
                raise FileExistsError(_BUSY.format(self.path)) from error
            try:
                same = os.stat(self.partial).st_ino == os.fstat(file.fileno()).st_ino
            except FileNotFoundError:
                same = False
            if not same:  # its writer has just completed and renamed it
                file.close()
                continue
            if known and file.tell() and not self._overwrite:
                file.close()
                raise FileExistsError(_UNFINISHED.format(self.partial))
            file.truncate(size)
            file.seek(size)
            return file

    def require_space(self, needed: int) -> None:
        """Raises ``OSError`` if the disk has less than ``needed`` bytes free."""
        free = shutil.disk_usage(self.path.parent).free
        if free < needed + _RESERVE + 2 * self._metadata_bytes:
            raise OSError(
                errno.ENOSPC,
                f"{self.path} needs about {needed / 2**20:.0f} MiB more and the disk has {free / 2**20:.0f} MiB free: "
                "make room or write elsewhere",
            )

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self._call(self._writer.add_metadata, name, dict(values))
        self._note(name, values)

    def _note(self, name: str, values: Mapping[str, str]) -> None:
        self._metadata.append((name, dict(values)))
        self._metadata_bytes += sum(len(key) + len(value) for key, value in values.items())

    def attach(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> None:
        self._call(self._writer.add_attachment, name, media_type, data)

    def channel(self, topic: str, schema: str, data: bytes) -> int:
        """The number of the channel for a topic, made at the first call."""
        if topic not in self._channels:
            if (schema, data) not in self._schemas:
                self._schemas[schema, data] = self._writer.add_schema(schema, "protobuf", data)
            self._channels[topic] = self._writer.add_channel(topic, "protobuf", self._schemas[schema, data])
        return self._channels[topic]

    def block(self, channel: int, times_ns: np.ndarray, rollouts: np.ndarray, size: int) -> np.ndarray:
        """Messages of ``size`` bytes of a channel, to be filled by the caller: uint8 [n, size].

        Their sequence numbers are the numbers of the rollouts they belong to.
        """
        return self._call(self._writer.block, channel, times_ns, rollouts, size)

    def add(self, channel: int, time_ns: int, data: bytes | memoryview, rollout: int) -> None:
        """One message."""
        body = self.block(channel, np.array([time_ns]), np.array([rollout]), len(data))
        body[0] = np.frombuffer(data, np.uint8)

    def end_chunk(self) -> None:
        """Keeps what follows apart from what was written: damage to one of them does not cost the other."""
        self._call(self._writer.end_chunk)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return os.fstat(self._file.fileno()).st_size

    def flush(self) -> None:
        """Hands everything over to the operating system."""
        self._call(self._writer.flush)
        self._flushed = time.monotonic()

    @property
    def flush_is_due(self) -> bool:
        return time.monotonic() - self._flushed > FLUSH_SECONDS

    def flush_if_due(self) -> None:
        if self.flush_is_due:
            self.flush()

    def _call(self, method: Callable[..., Any], *arguments: Any) -> Any:
        if self.closed:
            raise ValueError(f"the writer of {self.path} is closed")
        try:
            return method(*arguments)
        except OSError as error:
            self.abort()
            hint = _HINTS.get(error.errno or 0, f" ({error.strerror})")
            raise OSError(
                error.errno, f"{self.path} could not be written{hint}; what is complete is in {self.partial}"
            ) from error

    def finish(self) -> None:
        """Completes the partial file without giving it its name."""
        self._call(self._writer.end_chunk)
        self.attach(METADATA_COPY, json.dumps(self._metadata).encode(), "application/json")
        self._call(self._writer.finish)
        self._call(self._file.flush)
        self._call(os.fsync, self._file.fileno())
        self.closed = True

    def close(self) -> None:
        """Completes the file and gives it its name.

        Raises:
            FileExistsError: if a file of that name has appeared meanwhile and ``overwrite`` is False.
        """
        if self.closed:
            return
        self.finish()
        try:
            _check_free(self.path, self._overwrite)
            os.replace(self.partial, self.path)
        finally:
            self._file.close()

    def close_partial(self) -> None:
        """Completes the partial file and leaves it under that name."""
        if not self.closed:
            self.finish()
            self._file.close()

    def abort(self) -> None:
        """Leaves the partial file as it is."""
        self.closed = True
        with contextlib.suppress(OSError):  # what is still buffered does not fit either
            self._file.close()
