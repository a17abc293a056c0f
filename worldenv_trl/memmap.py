"""Memory-mapped tensors that do not fill the memory."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys

from tensordict import TensorDictBase

__all__ = ["Reading", "check_room", "release"]

_DONTNEED = 4  # of madvise
_MOST = 128_000_000  # bytes that are read before they are given back


def check_room(folder: str | os.PathLike, nbytes: int, what: str) -> None:
    """Raises ``OSError`` unless the disk of ``folder`` has room for ``what`` ("the frames of the episodes").

    To be asked before files are mapped: writing to one that the disk cannot hold kills the process without a word.
    """
    free = shutil.disk_usage(folder).free
    if nbytes > free:
        raise OSError(f"{what} take {nbytes / 1e9:.1f} GB, {folder} has {free / 1e9:.1f} GB free")


class Reading:
    """Counts what is read of memory-mapped frames and gives it back in time: what a file shows fills memory, too."""

    def __init__(self) -> None:
        self._bytes = 0

    def add(self, nbytes: int, *frames: TensorDictBase) -> None:
        """``nbytes`` of ``frames`` were read."""
        self._bytes += nbytes
        if self._bytes > _MOST:
            self._bytes = 0
            for each in frames:
                release(each)


def release(frames: TensorDictBase) -> None:
    """Lets the system take back the memory that shows files of memory-mapped ``frames``; they are read again if needed.

    Does nothing for tensors in memory, nor where there is no ``madvise``.
    """
    if not sys.platform.startswith("linux"):
        return
    libc = ctypes.CDLL(None)
    for value in frames.values(True, True):
        storage = value.untyped_storage()
        if storage.filename:  # never memory that no file stands behind
            libc.madvise(ctypes.c_void_p(storage.data_ptr()), ctypes.c_size_t(storage.nbytes()), _DONTNEED)
