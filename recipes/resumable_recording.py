"""A recording that a resumable loop writes, wave by wave: an interrupted one goes on in the very same file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from worldenv_trl.record import RolloutWriter


class ResumableRecording:
    """For :class:`resumable.Outside`. Opened at the first write: behind what the checkpoint of the loop says, or anew,
    over a file of that name.

    What was written after the checkpoint is cut off, and written again by the loop: the file ends as one that nothing
    interrupted, byte for byte.

    Args:
        path: ends in ``.mcap``.
        about: gives the options of :class:`~worldenv_trl.record.RolloutWriter`, where it is begun.
    """

    def __init__(self, path: Path, about: Callable[[], dict[str, Any]]) -> None:
        self.path, self._about = path, about
        self._writer: RolloutWriter | None = None
        self._state: dict[str, Any] | None = None

    @property
    def writer(self) -> RolloutWriter:
        if self._writer is None:
            if self._state is None:
                self._writer = RolloutWriter(self.path, **self._about(), overwrite=True)
            else:
                self._writer = RolloutWriter.resumed(self.path, self._state)
        return self._writer

    def state_dict(self) -> dict[str, Any]:
        return self.writer.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if not RolloutWriter.still_holds(self.path, state_dict):
            raise ValueError(f"what was recorded of {self.path} is cut short, damaged or gone")
        if self._writer is not None:
            self._writer.__exit__(ValueError)
        self._writer, self._state = None, state_dict

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or self._writer is not None:
            self.writer.__exit__(kind, error, trace)
