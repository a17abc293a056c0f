"""Rollouts of many rows, written as they happen by a thread behind a bounded queue."""

from __future__ import annotations

import contextlib
import json
import queue
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from worldenv_trl.keys import (
    ACTION,
    ACTION_MAP,
    INSTRUCTION,
    KINEMATIC_STATE,
    NUM_STEPS,
    PREDICTED_STATE,
    ROW,
    STEP_MASK,
    SUCCESS,
    SUCCESS_PROB,
    TERMINATION,
    TERMINATIONS,
)
from worldenv_trl.record.mcap.annotations import Annotator
from worldenv_trl.record.mcap.encoder import PERIOD_NS, RolloutEncoder
from worldenv_trl.record.mcap.file import FLUSH_SECONDS
from worldenv_trl.record.mcap.layout import Layout, same_camera
from worldenv_trl.record.mcap.recording import TEXT
from worldenv_trl.record.mcap.writer import FORMAT, open_file

if TYPE_CHECKING:
    from worldenv_trl.kinematics import ActionMap, ForwardKinematics

__all__ = ["RolloutStream", "painted"]

_Path = tuple[str, ...]
_CLOSE = object()
_BLOCK_BYTES = 8 * 2**20  # steps are written together, rollout by rollout: a third less time, a fifth less file
_BLOCK_CHUNKS = 8  # of which damage to one place costs one


class _Steps(NamedTuple):
    """Entries [n, ...] of the rollouts ``numbers`` at ``steps`` [n]; the rollouts ``first`` begin with ``begun``."""

    values: dict[_Path, Tensor]
    numbers: np.ndarray
    steps: np.ndarray
    first: np.ndarray
    begun: dict[_Path, Tensor]


class RolloutStream:
    """Writes steps of rows in the order in which they are put; an error of the thread is raised by the next call.

    Args:
        path, options: of the file.
        texts: paths of the entries that are text.
        rows: of the env.
        slot_steps: env steps for which a viewer's time line makes room for each rollout.
        limits: int64 [rows], env steps after which a rollout is truncated, if known: one that ends earlier was cut
            short.
        queue_size: steps that may wait.
        proprio: which state the env shows.
        kinematics, action_map: see :class:`~worldenv_trl.record.Recorder`.
    """

    def __init__(
        self,
        path: Path,
        options: Mapping[str, Any],
        texts: Sequence[_Path],
        *,
        rows: int,
        slot_steps: int,
        limits: Tensor | None,
        queue_size: int,
        proprio: str = "measured",
        kinematics: ForwardKinematics | None = None,
        action_map: ActionMap | None = None,
    ) -> None:
        self.path = path
        self._file = open_file(path, options["metadata"], options["attachments"], options["overwrite"])
        self._texts, self._slot_steps, self._limits, self._proprio = list(texts), slot_steps, limits, proprio
        self._kinematics, self._action_map, self._hand = kinematics, action_map, kinematics
        self._rows = rows
        self._before: Tensor | None = None  # kinematic states [rows, 20] before the step
        self._encoder: RolloutEncoder | None = None
        self._starts: list[int] = []
        self._lengths: list[int] = []
        self._said: list[tuple[str, ...]] = []  # distinct ones
        self._said_of: list[int] = []  # of each rollout
        self._time = 0
        self._annotator = Annotator(self._file, f"{FORMAT}.annotation", self._length, self._step_time)
        self._block: list[_Steps] = []
        self._block_bytes = 0
        self._lines: list[tuple[int, int, str, str]] = []  # text about rollouts of the block
        self._queue: queue.Queue = queue.Queue(queue_size)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name=f"recorder of {path.name}", daemon=True)
        self._thread.start()
        # A program that ends without closing its env still completes the file.
        self._finalizer = weakref.finalize(self, _end, self._queue, self._thread)

    # ------------------------------------------------------------------------------------------------- callers

    def put(
        self,
        values: dict[_Path, Tensor],
        begun: dict[_Path, Tensor],
        numbers: Tensor,
        steps: Tensor,
        fresh: Tensor,
        said: list[tuple[str, ...]] | None,
    ) -> None:
        """Entries [n, ...] of the rollouts ``numbers`` [n] at ``steps`` [n].

        ``fresh`` ones begin: with the observations ``begun`` [f, ...] and these texts. An entry in ``begun`` is given
        after the step only.
        """
        self._hand_over(lambda: self._write(values, begun, numbers.tolist(), steps.tolist(), fresh, said))

    def annotate(self, entries: TensorDictBase, rollouts: Sequence[int]) -> None:
        self._wait_for(lambda: self._annotator.write(entries, rollouts))

    def flush(self) -> None:
        self._wait_for(self._flush)

    def close(self) -> None:
        if self._thread.is_alive():
            self._queue.put(_CLOSE)
            self._thread.join()
        self._finalizer.detach()
        self._raise()

    def _hand_over(self, job: Callable[[], None]) -> None:
        self._raise()
        self._queue.put(job)

    def _wait_for(self, job: Callable[[], None]) -> None:
        done = threading.Event()
        failed: list[ValueError] = []

        def run() -> None:
            try:
                job()
            except ValueError as error:  # the caller's: the recording goes on
                failed.append(error)
            finally:
                done.set()

        self._hand_over(run)
        done.wait()
        self._raise()
        if failed:
            raise failed[0]

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    # ------------------------------------------------------------------------------------------------- thread

    def _work(self) -> None:
        while True:
            try:
                job = self._queue.get(timeout=FLUSH_SECONDS / 2)
            except queue.Empty:
                job = None
            try:
                if self._error is None:
                    if job is _CLOSE:
                        self._write_block()
                        # So that a reader knows of rollouts that are lost whole.
                        self._file.write_metadata(f"{FORMAT}.lengths", {"json": json.dumps(self._lengths)})
                        self._file.close()
                    elif job is not None:
                        job()
                    if job is not _CLOSE and self._file.flush_is_due:
                        self._flush()
            except BaseException as error:
                self._error = error
                if not self._file.closed:
                    with contextlib.suppress(Exception):  # what came before the error
                        self._flush()
                    self._file.abort()
            if job is _CLOSE:
                return

    def _flush(self) -> None:
        self._write_block()
        self._file.flush()

    def _write(
        self,
        values: dict[_Path, Tensor],
        begun: dict[_Path, Tensor],
        numbers: list[int],
        steps: list[int],
        fresh: Tensor,
        said: list[tuple[str, ...]] | None,
    ) -> None:
        with torch.no_grad():
            self._derive(values, begun, fresh)
        self._begin_texts(said)
        values[(TEXT,)] = torch.tensor([[self._said_of[number]] for number in numbers])
        if self._encoder is None:
            flat = {key: value.unsqueeze(1) for key, value in (values | begun).items()}
            layout = Layout.of(flat, self._texts, torch.ones(len(numbers), 1, dtype=torch.bool))
            self._file.write_metadata(
                f"{FORMAT}.stream", {"json": json.dumps({"layout": layout.to_json(), "prefix": ""})}
            )
            self._encoder = RolloutEncoder(self._file, layout, "")
            entries = (*layout.numbers, *layout.images)
            self._expected = [
                (e, e.key if e.stored == "root" else ("next", *e.key), torch.Size(e.shape), e.torch_dtype)
                for e in entries
            ]
            self._entry_bytes = sum(entry.nbytes for entry in entries)
        self._check(values)
        for entry in self._layout.images:
            if entry.stored == "chained_from_zero" and entry.key in begun and bool(begun[entry.key].any()):
                raise ValueError(f"entry {entry.key} was zero when the first rollout began, it must be so in all")
        for number in numbers:
            if number == len(self._starts):
                self._starts.append(self._time)
                self._lengths.append(0)
                self._time += (self._slot_steps + 1) * PERIOD_NS
            self._lengths[number] += 1
        of = np.asarray(numbers, np.int64)
        self._block.append(_Steps(values, of, np.asarray(steps, np.int64), of[fresh.numpy()], begun))
        self._block_bytes += len(numbers) * self._entry_bytes
        self._report(values, numbers)
        if self._block_bytes > _BLOCK_BYTES:
            self._write_block()

    def _write_block(self) -> None:
        """Writes what has gathered rollout by rollout, in a few chunks."""
        block, self._block, self._block_bytes = self._block, [], 0
        encoder = self._encoder
        if encoder is None:  # nothing was put yet
            return
        if block:
            numbers = np.concatenate([part.numbers for part in block])
            steps = np.concatenate([part.steps for part in block])
            order = np.argsort(numbers, kind="stable")  # in each rollout, steps follow each other
            values = {key: _joined([part.values[key] for part in block], order) for key in block[0].values}
            numbers, steps = numbers[order], steps[order]
            first = np.concatenate([part.first for part in block])
            beginning = [part.begun for part in block if len(part.first)]
            begun = {key: torch.cat([each[key] for each in beginning]) for key in (beginning or [{}])[0]}
            starts = np.asarray(self._starts, np.int64)
            for chosen in _shares(numbers, _BLOCK_CHUNKS):
                fresh = np.isin(first, numbers[chosen]).nonzero()[0]
                if len(fresh):
                    encoder.reset(first[fresh], starts[first[fresh]], {k: v[fresh] for k, v in begun.items()})
                of = numbers[chosen]
                encoder.steps(of, steps[chosen], starts[of], {key: v[chosen] for key, v in values.items()})
                self._file.end_chunk()
        lines, self._lines = self._lines, []
        for line in lines:
            encoder.say(*line)

    @property
    def _layout(self) -> Layout:
        assert self._encoder is not None  # asked for once something was put
        return self._encoder.layout

    def _begin_texts(self, said: list[tuple[str, ...]] | None) -> None:
        for words in said or ():
            if words not in self._said:
                self._said.append(words)
                value = [[list(path), word] for path, word in zip(self._texts, words, strict=True)]
                self._file.write_metadata(f"{FORMAT}.texts", {"json": json.dumps(value)})
            self._said_of.append(self._said.index(words))

    def _derive(self, values: dict[_Path, Tensor], begun: dict[_Path, Tensor], fresh: Tensor) -> None:
        """Adds the entries that are the recorder's own."""
        after = values.get(("next", KINEMATIC_STATE))
        if self._kinematics is not None and after is not None and (ACTION,) in values:
            rows = values[(ROW,)].flatten()
            if self._before is None:
                self._before = after.new_zeros(self._rows, after.shape[-1])
            if bool(fresh.any()):
                self._before[rows[fresh]] = begun[(KINEMATIC_STATE,)]
            predicted = self._kinematics(self._before[rows], values[(ACTION,)])
            values["next", PREDICTED_STATE] = self._kinematics.state(predicted, self._proprio)
            self._before[rows] = after
        if self._action_map is not None and after is not None:
            if self._hand is None:
                from worldenv_trl.kinematics import ForwardKinematics  # builds on MuJoCo; reading does not need it

                self._hand = ForwardKinematics()
            pose = self._hand.pose(after)
            values["next", ACTION_MAP] = painted(self._action_map(pose, tool_pose=pose))
        terminated, truncated = (values.get(("next", name)) for name in ("terminated", "truncated"))
        if terminated is not None and truncated is not None:
            values["next", TERMINATION] = self._causes(values, terminated, truncated)

    def _causes(self, values: dict[_Path, Tensor], terminated: Tensor, truncated: Tensor) -> Tensor:
        """int64 [n, 1]."""
        if not bool((terminated | truncated).any()):
            return torch.zeros_like(terminated, dtype=torch.int64)
        success, judged = values.get(("next", SUCCESS)), ("next", SUCCESS_PROB) in values
        reached = torch.zeros_like(terminated) if success is None else success.reshape(terminated.shape)
        by_goal = torch.full_like(terminated, TERMINATIONS.index("success"), dtype=torch.int64)
        stopped = torch.full_like(by_goal, TERMINATIONS.index("reflector" if judged else "success"))
        limit = torch.full_like(by_goal, TERMINATIONS.index("step limit"))
        count = values.get(("next", NUM_STEPS))
        if self._limits is not None and count is not None:
            most = self._limits[values[(ROW,)].flatten()].reshape(limit.shape)
            limit[count.reshape(limit.shape) < most] = TERMINATIONS.index("cut short")
        cause = torch.where(truncated, limit, torch.zeros_like(limit))
        return torch.where(terminated, stopped if judged else torch.where(reached, by_goal, stopped), cause)

    def _check(self, values: dict[_Path, Tensor]) -> None:
        """What the first step showed about the entries must hold for all."""
        for entry, key, shape, dtype in self._expected:
            value = values.get(key)
            if value is None or value.shape[1:] != shape or value.dtype != dtype:
                found = "is missing" if value is None else f"is {value.dtype} {list(value.shape[1:])}"
                raise ValueError(f"entry {key} {found}, it was {entry.dtype} {list(entry.shape)} when recording began")
            frames = same_camera(entry.key)
            if entry.stored == "last_of_frames" and frames is not None:
                last = (values["next", STEP_MASK].sum(-1) - 1).clamp(min=0)
                shown = values["next", *frames][torch.arange(len(last)), last]
                if not torch.equal(shown, values[key]):
                    raise ValueError(f"entry {key} is not the last executed one of {frames}, as it was at first")

    def _report(self, values: dict[_Path, Tensor], numbers: list[int]) -> None:
        """A line of text for each rollout that has ended."""
        cause = values.get(("next", TERMINATION))
        if cause is None:
            return
        place = next((i for i, path in enumerate(self._texts) if path[-1] == INSTRUCTION), None)
        for index in cause.flatten().nonzero().squeeze(-1).tolist():
            number = numbers[index]
            words = "" if place is None else self._said[self._said_of[number]][place]
            at = self._step_time(number, self._lengths[number] - 1)
            self._lines.append((number, at, words, TERMINATIONS[int(cause[index])]))

    def _length(self, number: int) -> int:
        if not 0 <= number < len(self._lengths):
            raise KeyError(number)
        return self._lengths[number]

    def _step_time(self, number: int, step: int) -> int:
        return self._starts[number] + (step + 1) * self._layout.steps_per_entry * PERIOD_NS


def painted(maps: Tensor) -> Tensor:
    """Action maps [*B, 6, H, W] as images for the eye, uint8 [*B, 3, H, W]: axes red, green and blue, the hand white,
    its shadow grey."""
    hand = torch.maximum(maps[..., 0, :, :], maps[..., 4, :, :]).maximum(0.4 * maps[..., 5, :, :])
    return (torch.maximum(maps[..., 1:4, :, :], hand.unsqueeze(-3)) * 255).round().to(torch.uint8)


def _joined(parts: list[Tensor], order: np.ndarray) -> Tensor:
    """Values [n, ...] of several steps in another order."""
    count = len(parts[0])
    if len(order) == len(parts) * count and (order.reshape(count, -1) == _by_row(len(parts), count)).all():
        return torch.stack(parts, 1).flatten(0, 1)  # one copy instead of two
    return torch.cat(parts)[torch.from_numpy(order)]


def _by_row(steps: int, rows: int) -> np.ndarray:
    return np.arange(rows)[:, None] + rows * np.arange(steps)


def _shares(numbers: np.ndarray, most: int) -> Iterator[slice]:
    """``numbers`` [n], in which equal ones stand together, in at most so many parts that do not divide them."""
    ends = [*(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    begin = 0
    for end in ends:
        if end - begin >= len(numbers) / most or end == len(numbers):
            yield slice(begin, end)
            begin = end


def _end(jobs: queue.Queue, thread: threading.Thread) -> None:
    if thread.is_alive() and threading.current_thread() is not thread:
        jobs.put(_CLOSE)
        thread.join(timeout=60)
