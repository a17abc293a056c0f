"""Processes that collect for another one: what every back end offers, and that of this machine."""

from __future__ import annotations

import itertools
import os
import signal
import tempfile
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol

import cloudpickle
import torch

__all__ = ["ATTEMPTS", "ProcessWorkers", "Stored", "Workers"]

ATTEMPTS = 3
"""Times that a share whose worker dies is given out, before it is taken to be what kills them."""


class Stored(Protocol):
    """A value that workers read once each, whatever they do with it."""

    name: str

    def get(self) -> Any: ...


class Workers(Protocol):
    """Processes with one thread each, on this machine or on others.

    A call is a function of its arguments: when its worker dies, another one gets the same call.
    """

    count: int

    def put(self, value: Any) -> Stored:
        """Leaves a value where workers can read it, until what is returned is gone."""

    def map(self, function: Callable[..., Any], arguments: Sequence[tuple]) -> list[Any]:
        """``function(*each)`` for each of ``arguments``, in their order, by whichever worker is free.

        Raises:
            RuntimeError: if the workers of the same calls die again and again.
        """

    def shutdown(self) -> None:
        """Ends the processes."""


class ProcessWorkers:
    """Processes of this machine.

    They start at the first call. When one dies (out of memory, killed), all are started anew, and the calls that were
    not finished are made again.

    Args:
        count: of processes.

    Raises:
        ValueError: if ``count`` is below 1.

    Examples:
        >>> from math import hypot
        >>> workers = ProcessWorkers(1)
        >>> workers.map(hypot, [(3, 4), (6, 8)])
        [5.0, 10.0]
        >>> workers.shutdown()
    """

    def __init__(self, count: int) -> None:
        if count < 1:
            raise ValueError(f"workers must be at least 1, got {count}")
        self.count = count
        self._executor: ProcessPoolExecutor | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="worldenv_trl_workers_")
        self._numbers = itertools.count()

    def put(self, value: Any) -> Stored:
        return _File(Path(self._folder.name) / str(next(self._numbers)), value)

    def map(self, function: Callable[..., Any], arguments: Sequence[tuple]) -> list[Any]:
        waiting, results, attempts = dict(enumerate(arguments)), {}, 0
        while waiting:
            futures: dict[Future, int] = {}
            try:
                for place, each in waiting.items():
                    futures[self._started().submit(_call, cloudpickle.dumps((function, each)))] = place
                for future in as_completed(futures):
                    results[futures[future]] = cloudpickle.loads(future.result())
            except BrokenProcessPool as error:
                lost = len(waiting.keys() - results.keys())
                warnings.warn(
                    f"a worker process died (killed, or out of memory); parts of the work that are done again: {lost}",
                    stacklevel=2,
                )
                self._end()
                attempts = 1 if results.keys() & waiting.keys() else attempts + 1
                if attempts == ATTEMPTS:
                    raise RuntimeError(
                        f"a worker process died {ATTEMPTS} times at the same work and was replaced each time: it may "
                        f"be out of memory; use fewer workers than {self.count}, or smaller batches"
                    ) from error
            except BaseException:
                self._end()  # Ctrl-C, or an error in one of them: nobody waits for the others
                raise
            waiting = {place: each for place, each in waiting.items() if place not in results}
        return [results[place] for place in range(len(arguments))]

    def shutdown(self) -> None:
        self._end()
        self._folder.cleanup()

    @property
    def pids(self) -> list[int]:
        """Of the processes that run."""
        return [] if self._executor is None else list(self._executor._processes or ())

    def _started(self) -> ProcessPoolExecutor:
        if self._executor is None:
            self._executor = ProcessPoolExecutor(self.count, mp_context=get_context("spawn"), initializer=_begin)
        return self._executor

    def _end(self) -> None:
        if self._executor is not None:
            for process in list((self._executor._processes or {}).values()):
                process.kill()  # what they hold is theirs alone, and a share takes long to finish
            self._executor.shutdown(cancel_futures=True)
            self._executor = None


class _File:
    """A value in a file, which goes with the object that made it."""

    def __init__(self, path: Path, value: Any) -> None:
        self.name, self._path, self._made_here = str(path), path, True
        path.write_bytes(cloudpickle.dumps(value))

    def get(self) -> Any:
        return cloudpickle.loads(self._path.read_bytes())

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_made_here": False}

    def __del__(self) -> None:
        if self._made_here:
            self._path.unlink(missing_ok=True)


def _begin() -> None:
    """What a process does first."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # Ctrl-C reaches all: the one that was asked says so
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _call(packed: bytes) -> bytes:
    function, arguments = cloudpickle.loads(packed)
    # Bytes, not tensors in shared memory: those of a process that dies would be lost on the way.
    return cloudpickle.dumps(function(*arguments))


def _end_with(parent: BaseProcess) -> None:
    parent.join()  # killed, or it would have ended this process itself
    os._exit(1)
