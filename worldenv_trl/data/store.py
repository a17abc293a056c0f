"""Episodes on disk: recordings read once into memory-mapped frames, which training then reads."""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer

from worldenv_trl.data.episodes import Episodes, check_alike, concatenated
from worldenv_trl.data.from_rollouts import episodes_from_rollouts
from worldenv_trl.keys import ACTION, CHUNK
from worldenv_trl.memmap import check_room, release
from worldenv_trl.record import list_rollouts, read_metadata, read_rollouts
from worldenv_trl.record.mcap.recording import Recording

__all__ = ["FrameSink", "fill_store", "open_store"]

_MANIFEST = "episodes.json"
_FORMAT = 1
_AT_ONCE = 16  # rollouts in memory while a recording is read


class FrameSink:
    """Takes frames in order into a ReplayBuffer, on disk or in memory.

    Args:
        capacity: most frames.
        folder: of the memory-mapped files, which are written over; None keeps them in memory.
    """

    def __init__(self, capacity: int, folder: str | os.PathLike | None = None) -> None:
        disk = folder is not None
        storage = (
            LazyMemmapStorage(capacity, scratch_dir=folder, existsok=True) if disk else LazyTensorStorage(capacity)
        )
        self.buffer = ReplayBuffer(storage=storage, batch_size=1)
        self._capacity, self._folder = capacity, None if folder is None else Path(folder)
        self._count = self._summed = 0
        self._sums: dict[str, int] = {}  # checksums of the first `_summed` frames

    def add(self, frames: TensorDictBase) -> None:
        """``frames`` [n] behind those that are there.

        Raises:
            ValueError: if they are more than there is room for; none of them is taken.
            OSError: if the disk has no room for as many as there may be; nothing is written.
        """
        if self._folder is not None and not self._count and len(frames):
            self._folder.mkdir(parents=True, exist_ok=True)
            check_room(self._folder, self._capacity * frames[:1].bytes(), "the frames of the episodes")
        if self._count + len(frames) > self._capacity:  # the buffer would write over its first ones, in silence
            raise ValueError(
                f"there is room for {self._capacity} frames, {self._count} are there: {len(frames)} do not fit"
            )
        with without_notices():
            self.buffer.extend(frames)
        self._count += len(frames)
        if self._folder is not None:
            release(self.frames)

    @property
    def frames(self) -> TensorDictBase:
        """All frames [F] so far, not copied."""
        return self.buffer.storage.get(slice(0, self._count))

    def state_dict(self) -> dict[str, Any]:
        """How many frames there are, and their checksums; they themselves are on the disk by then.

        Raises:
            ValueError: for frames in memory.
        """
        if self._folder is None:
            raise ValueError("frames in memory go with the process: give the sink a folder")
        if self._count:
            self._sums = _summed(self.frames[self._summed :], self._sums)
            self._summed = self._count
            self.buffer.storage.dumps(self._folder)
            release(self.frames)
            for path in self._folder.rglob("*.memmap"):
                with path.open("rb+") as file:
                    os.fsync(file.fileno())
        return {"count": self._count, "sums": dict(self._sums)}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Goes on behind the frames that were in the folder when :meth:`state_dict` gave this.

        Raises:
            ValueError: if they are no longer there, bit for bit; nothing is changed then.
        """
        if self._folder is None:
            raise ValueError("frames in memory go with the process: give the sink a folder")
        count, sums = int(state_dict["count"]), dict(state_dict["sums"])
        if count:
            try:
                frames = TensorDict.load_memmap(self._folder)[:count]
                found = _summed(frames, {})
                release(frames)
            except (OSError, RuntimeError, KeyError, ValueError):
                found = {}
            if found != sums:
                raise ValueError(f"the frames in {self._folder} are cut short, damaged or gone")
            self.buffer.storage.loads(self._folder)
        self.buffer.writer.load_state_dict({"_cursor": count})
        self._count, self._summed, self._sums = count, count, sums


def _summed(frames: TensorDictBase, sums: Mapping[str, int]) -> dict[str, int]:
    """Checksums, by camera, of what has ``sums`` and ``frames`` behind it."""
    leaves = {"/".join(key): value for key, value in frames.items(True, True)}
    return {name: zlib.crc32(value.numpy().data, sums.get(name, 0)) for name, value in sorted(leaves.items())}


def fill_store(folder: str | os.PathLike, recordings: Sequence[str | os.PathLike]) -> list[Episodes]:
    """Reads ``recordings`` (MCAP) into ``folder``, which is replaced, and opens it; see :func:`open_store`.

    Small entries are kept beside the frames. Only some rollouts are in memory at a time. A damaged recording gives what
    :func:`~worldenv_trl.record.read_rollouts` reads of it, with its warning.

    Raises:
        ValueError: for recordings that cannot be made into episodes, or of different entries, cameras or sizes, or one
            that is named twice.
        OSError: if the disk has no room for the frames.

    Examples:
        >>> import tempfile
        >>> from worldenv_trl.envs import TabletopEnv
        >>> from worldenv_trl.record import RolloutWriter
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with RolloutWriter(f"{folder}/demo.mcap") as writer:
        ...         numbers = writer.write(TabletopEnv("starter/open_the_top_drawer", 3, seed=0).rollout(5))
        ...     (episodes,) = fill_store(f"{folder}/store", [f"{folder}/demo.mcap"])
        ...     last = episodes.frames("agentview", torch.arange(3), torch.tensor(5))
        >>> numbers, last.shape
        ([0, 1, 2], torch.Size([3, 3, 64, 64]))
    """
    if len({Path(path).resolve() for path in recordings}) < len(recordings):
        raise ValueError(f"recordings must be named each once, got {', '.join(map(str, recordings))}")
    folder = Path(folder)
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    sink: FrameSink | None = None
    alike: Episodes | None = None
    entries: list[TensorDict] = []
    texts: list[str] = []
    counts = {path: Recording(Path(path)).count() for path in recordings}
    capacity = sum(count * (_longest(path) + 1) for path, count in counts.items() if count)
    held = dict.fromkeys(counts, 0)  # of a damaged recording fewer than it counts
    for path, part in ((each, part) for each, count in counts.items() for part in _parts(each, count)):
        frames, _ = part.video
        if sink is None or alike is None:
            sink = FrameSink(capacity, partial / "frames")
            alike = Episodes(part.entries[:0], [], frames[:0].clone())
        check_alike([alike, part])
        sink.add(frames)
        entries.append(part.entries)
        texts += part.instructions
        held[path] += len(part)
    if sink is None:
        raise ValueError(f"there are no rollouts in {', '.join(map(str, recordings)) or 'no recordings'}")
    concatenated(entries).memmap(partial / "entries")
    distinct = sorted(set(texts))
    manifest = {
        "format": _FORMAT,
        "recordings": [_identity(path) for path in recordings],
        "counts": list(held.values()),
        "frames": len(sink.frames),
        "files": {str(path.relative_to(partial)): path.stat().st_size for path in _files(partial)},
        "instructions": distinct,
        "instruction": [distinct.index(text) for text in texts],
    }
    # Last: a store without its manifest is not finished.
    (partial / _MANIFEST).write_text(json.dumps(manifest))
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(partial, folder)
    return open_store(folder, recordings)


def open_store(folder: str | os.PathLike, recordings: Sequence[str | os.PathLike]) -> list[Episodes]:
    """The episodes of each of ``recordings`` that :func:`fill_store` left in ``folder``; all share one set of frames.

    Raises:
        FileNotFoundError: if there is no store, or a recording is gone.
        ValueError: for a store of other recordings or another format, or one that was cut short; :func:`fill_store`
            makes it anew from the recordings, which are the record.
    """
    folder = Path(folder)
    remedy = "fill_store makes it anew from the recordings"
    if not (folder / _MANIFEST).is_file():
        raise FileNotFoundError(f"no episode store at {folder}: {remedy}")
    try:
        manifest = json.loads((folder / _MANIFEST).read_text())
        if manifest["format"] != _FORMAT:
            raise ValueError(f"the episode store {folder} has format {manifest['format']}, not {_FORMAT}: {remedy}")
        held, wanted = manifest["recordings"], [_identity(path) for path in recordings]
        files = dict(manifest["files"])
    except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"the episode store {folder} is cut short ({error!r}): {remedy}") from error
    if held != wanted:
        names = [", ".join(str(each["name"]) for each in side) for side in (held, wanted)]
        changed = " as they were before they changed" if names[0] == names[1] else ""
        raise ValueError(
            f"the episode store {folder} belongs to other recordings, {names[0]}{changed}, not {names[1]}: {remedy}"
        )
    # Before they are mapped: that would fill up what is missing with zeros, in silence.
    there = {str(path.relative_to(folder)): path.stat().st_size for path in _files(folder)}
    short = [name for name, size in files.items() if there.get(name) != size]
    if short:
        raise ValueError(
            f"the episode store {folder} is cut short ({short[0]} has {there.get(short[0], 0)} of {files[short[0]]} "
            f"bytes): {remedy}"
        )
    try:
        frames = TensorDict.load_memmap(folder / "frames")[: manifest["frames"]]
        entries = TensorDict.load_memmap(folder / "entries").clone()
        texts = [manifest["instructions"][index] for index in manifest["instruction"]]
        episodes = Episodes(entries, texts, frames)
        ends = torch.tensor([0, *manifest["counts"]]).cumsum(0).tolist()
        return [episodes[start:end] for start, end in itertools.pairwise(ends)]
    except (OSError, RuntimeError, KeyError, IndexError, ValueError) as error:
        raise ValueError(f"the episode store {folder} is cut short or damaged ({error}): {remedy}") from error


def _files(folder: Path) -> list[Path]:
    """Those of a store's frames and entries."""
    return sorted(path for part in ("frames", "entries") for path in (folder / part).rglob("*") if path.is_file())


@contextmanager
def without_notices() -> Iterator[None]:
    """TorchRL tells of every storage that it begins."""
    before = torchrl_logger.level
    torchrl_logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        torchrl_logger.setLevel(before)


def _parts(path: str | os.PathLike, count: int) -> Iterator[Episodes]:
    for start in range(0, count, _AT_ONCE):
        yield episodes_from_rollouts(read_rollouts(path, rollouts=slice(start, start + _AT_ONCE)))


def _longest(path: str | os.PathLike) -> int:
    """No rollout of a recording has more env steps: what its env was limited to, or else what it holds."""
    limits = read_metadata(path).get("env", {}).get("max_steps")
    if limits is not None:
        return int(max(limits)) if isinstance(limits, list) else int(limits)
    one = read_rollouts(path, rollouts=[0])
    steps = 1 if one.get(ACTION, None) is not None else one[CHUNK].shape[-2]
    return steps * max(info.length for info in list_rollouts(path))


def _identity(path: str | os.PathLike) -> dict[str, str | int]:
    """What a recording is recognised by: its name, size and ends, where MCAP keeps its header and its index."""
    path = Path(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        digest = hashlib.sha256(file.read(1 << 16))
        file.seek(max(0, size - (1 << 20)))
        digest.update(file.read())
    return {"name": path.name, "bytes": size, "sha256": digest.hexdigest()}
