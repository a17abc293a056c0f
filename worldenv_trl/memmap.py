"""Memory-mapped tensors that do not fill the memory."""

from __future__ import annotations

import ctypes
import sys

from tensordict import TensorDictBase

__all__ = ["release"]

_DONTNEED = 4  # of madvise


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
