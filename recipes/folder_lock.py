"""One run at a time in a run folder."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from weakref import WeakValueDictionary

FILE = "run.lock"


class FolderLock:
    """Held until no one refers to it any more, or its process ends, however it ends."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def __del__(self) -> None:
        os.close(self._descriptor)


# The system locks files for whoever opened them: a process that opens a folder twice would lock itself out.
_HELD: WeakValueDictionary[tuple[int, int], FolderLock] = WeakValueDictionary()


def lock_folder(folder: Path) -> FolderLock:
    """The lock of an existing folder, the same one for all of this process.

    Raises:
        BlockingIOError: if another process holds it, naming that process.
    """
    descriptor = os.open(folder / FILE, os.O_RDWR | os.O_CREAT, 0o644)
    status = os.fstat(descriptor)
    file = status.st_dev, status.st_ino
    held = _HELD.get(file)
    if held is not None:
        os.close(descriptor)
        return held
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        holder = os.pread(descriptor, 32, 0).decode(errors="replace").strip()
        os.close(descriptor)
        by = f"process {holder}" if holder.isdigit() else "another process"
        raise BlockingIOError(
            f"{folder} is in use by {by}: wait until it has ended, or choose another --run-dir"
        ) from error
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    lock = _HELD[file] = FolderLock(descriptor)
    return lock
