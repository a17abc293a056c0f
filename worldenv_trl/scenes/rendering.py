"""Rendering many rows of one or several models, with a few processes, one GL context each."""

from __future__ import annotations

import atexit
import contextlib
import importlib
import itertools
import os
import select
import tempfile
import time
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

_BACKEND = os.environ.get("MUJOCO_GL", "the default")
_REMEDY = (
    "install Debian's libegl1, libgl1-mesa-dri and libosmesa6 (bash .ci/install does), "
    "and set MUJOCO_GL=egl or MUJOCO_GL=osmesa before Python starts (MUJOCO_GL=off does without images)"
)

try:
    import mujoco
    from dm_control import composer  # noqa: F401 - loads GL as well, and fails where it cannot
    from mujoco.rendering.classic import gl_context

    if _BACKEND in ("egl", "osmesa") and "glfw" in gl_context.GLContext.__module__:
        # MuJoCo was imported (TorchRL does) before this package chose a backend, and took the one that needs a display.
        gl_context.GLContext = importlib.import_module(f"mujoco.{_BACKEND}").GLContext
except ModuleNotFoundError:
    raise
except (ImportError, AttributeError, RuntimeError) as error:
    raise ImportError(f"GL cannot be loaded with MUJOCO_GL={_BACKEND!r} ({error}): {_REMEDY}") from error

from worldenv_trl.scenes.canvas import Canvas, Glow  # noqa: E402 - imports MuJoCo, which must have found its GL
from worldenv_trl.scenes.painters import Helper, Painter, Row  # noqa: E402
from worldenv_trl.scenes.shared_rows import RECORD, Layout, SharedRows  # noqa: E402

__all__ = ["Drawing", "RendererPool", "Row"]

PAYS_AFTER = 0.5  # seconds of drawing, about what it costs to start a helper: at worst that is paid twice
_SHARED_ROWS = 4  # of a drawing; with fewer, it is left to one painter
_PATIENCE = 60_000  # ms that a helper may be silent before it is given up
_MOST_TICKETS = 2048  # fit into a pipe, whose writer would wait for readers otherwise


class RendererPool:
    """Draws rows of every model that was added: on a thread of its own, helped by ``num_threads - 1`` processes.

    Two threads of one process hardly draw faster than one. Helpers are started in the background once the pool has
    drawn for half a second, and join in when they are ready: a pool that draws little never pays for them. Painters
    take the next row as they get there, and a row's image is the same bit for bit whoever draws it. If a helper fails,
    what it was drawing is drawn again here and the pool goes on without, with a warning.

    Raises:
        RuntimeError: if no GL context can be made; the message says what to install.
    """

    def __init__(self, num_threads: int) -> None:
        self._drawings: list[Drawing] = []
        self._painter = Painter()
        self._crew = _Crew(min(num_threads, _cores()) - 1)
        # A GL context is freed on the thread that made it. At exit this must come before MuJoCo ends EGL, whose own
        # exit handler was registered when the first context was made: later ones run earlier.
        self._close = weakref.finalize(self, _stop, self._painter, self._crew)
        self._close.atexit = False
        self._check(self._painter.wait())
        atexit.register(self._close)
        self._frames: _Frames | None = None
        self._seconds = 0.0

    def add(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[str],
        image_size: int,
        num_rows: int,
        glows: Sequence[Glow] = (),
    ) -> Drawing:
        """What draws rows of ``model``, of which there are ``num_rows`` at most; see :class:`Canvas` for the rest.

        Few rows are left to one painter: each that takes part costs memory and time to set up.
        """
        number = len(self._drawings)
        home = None if num_rows >= _SHARED_ROWS else number % max(1, self._crew.size + 1)
        drawing = Drawing(self, number, home, model, tuple(cameras), image_size, num_rows, tuple(glows))
        self._painter.call(drawing._open)
        self._check(self._painter.wait())
        self._drawings.append(drawing)
        self._crew.add(drawing)
        return drawing

    def render(self, drawings: Sequence[Drawing], rows: Sequence[Sequence[Row]]) -> list[dict[str, np.ndarray]]:
        """Draws several models at once: for each, and each camera, ``[len(rows), 3, H, W]`` uint8, upright."""
        return self.start(drawings, rows)()

    def start(
        self, drawings: Sequence[Drawing], rows: Sequence[Sequence[Row]]
    ) -> Callable[[], list[dict[str, np.ndarray]]]:
        """Begins to ``render``; what it returns must be called, waits for the end and gives the images."""
        if self._frames is not None:
            with contextlib.suppress(Exception):
                self._frames.finish()  # its caller was interrupted
        if self._seconds > PAYS_AFTER:
            self._crew.hire(self._drawings)
        self._frames = _Frames(self, drawings, rows)
        return self._frames.finish

    @property
    def helpers(self) -> list[int]:
        """Process ids of the helpers that are ready to draw."""
        return [helper.pid for helper in self._crew.ready()]

    def close(self) -> None:
        """Frees the GL contexts and ends the helpers."""
        self._close()
        atexit.unregister(self._close)

    def _check(self, error: Exception | None) -> None:
        if error is not None:
            self._close()
            raise RuntimeError(f"no image can be rendered with MUJOCO_GL={_BACKEND!r} ({error}): {_REMEDY}") from error


@dataclass(frozen=True, eq=False)
class Drawing:
    """A model in a pool, with its cameras; ``home`` is the painter that draws it, None if all do."""

    pool: RendererPool
    number: int
    home: int | None
    model: mujoco.MjModel
    cameras: tuple[str, ...]
    image_size: int
    num_rows: int
    glows: tuple[Glow, ...]

    def render(self, rows: Sequence[Row]) -> dict[str, np.ndarray]:
        """For each camera ``[len(rows), 3, H, W]`` uint8, upright."""
        return self.pool.render([self], [rows])[0]

    def _open(self, painter: Painter) -> None:
        painter.canvases[self.number] = Canvas(self.model, self.cameras, self.image_size, self.glows)


class _Crew:
    """The helpers of a pool, the file they share with it, and the pipe that brings them work."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.shared: dict[int, SharedRows] = {}  # number of a drawing: its part of the file
        self._helpers: list[Helper] = []
        self._memory = self.tickets = self._write_end = -1
        self._end = 0

    def hire(self, drawings: Sequence[Drawing]) -> None:
        """Starts the helpers, unless that was done before, or they would have little to do."""
        if self._memory >= 0 or self.size < 1 or sum(drawing.num_rows for drawing in drawings) < _SHARED_ROWS:
            return
        try:
            self._memory = _anonymous_file()
            self.tickets, self._write_end = os.pipe()
            os.set_blocking(self.tickets, False)
            for _ in range(self.size):
                self._helpers.append(Helper(self._memory, self.tickets))
        except (OSError, ValueError) as error:
            self.dismiss(str(error))
        for drawing in drawings:
            self.add(drawing)

    def add(self, drawing: Drawing) -> None:
        if not self._helpers:
            return
        model = np.empty(mujoco.mj_sizeModel(drawing.model), np.uint8)
        mujoco.mj_saveModel(drawing.model, None, model)
        layout = Layout(
            self._end, drawing.num_rows, drawing.model.nq, drawing.model.nmocap, drawing.cameras, drawing.image_size,
            len(model), drawing.glows,
        )  # fmt: skip
        self._end += layout.size
        try:
            os.truncate(self._memory, self._end)
            self.shared[drawing.number] = shared = SharedRows(self._memory, layout)
            shared.model[:] = model
            for helper in self._helpers:
                helper.add(layout)
        except OSError as error:
            self.dismiss(str(error))

    def ready(self) -> list[Helper]:
        """The helpers, if all of them have all drawings."""
        try:
            for helper in self._helpers:
                while helper.due and select.select([helper.reports], [], [], 0)[0]:
                    helper.read()
                    helper.due -= 1
        except OSError as error:
            self.dismiss(str(error))
        return [] if any(helper.due for helper in self._helpers) else self._helpers

    def issue(self, tickets: Iterable[bytes]) -> None:
        """Offers rows to every painter, this process's included."""
        os.write(self._write_end, b"".join(tickets))

    def take(self) -> bytes | None:
        """The next row that no painter has taken."""
        try:
            return os.read(self.tickets, RECORD.size)
        except BlockingIOError:
            return None

    def reports(self) -> list[bytes]:
        """Waits for what helpers have drawn. Raises ``OSError`` if one is gone or silent."""
        poll = select.poll()
        for helper in self._helpers:
            poll.register(helper.reports, select.POLLIN)
        if not (ready := [file for file, _ in poll.poll(_PATIENCE)]):
            raise TimeoutError(f"it did not answer for {_PATIENCE // 1000} s")
        return [helper.read() for helper in self._helpers if helper.reports in ready]

    def dismiss(self, reason: str | None = None) -> None:
        """Ends the helpers for good; with a ``reason``, that is a failure and is said."""
        self.size, gone = 0, self._helpers[:]
        self._helpers.clear()
        self.shared.clear()
        said = [helper.stop(1.0 if reason else 0.0) for helper in gone]
        for file in (self._memory, self.tickets, self._write_end):
            if file >= 0:
                os.close(file)
        self._memory = self.tickets = self._write_end = -1
        if reason is not None:
            reasons = "; ".join([reason, *said])
            warnings.warn(
                f"images are drawn by this process alone from now on, a process that helped failed ({reasons})",
                RuntimeWarning,
                stacklevel=2,
            )


class _Frames:
    """Images that are being drawn; rows that helpers may draw are ``open`` until they are drawn."""

    def __init__(self, pool: RendererPool, drawings: Sequence[Drawing], rows: Sequence[Sequence[Row]]) -> None:
        self._pool, self._crew, self._painter = pool, pool._crew, pool._painter
        self._helpers = list(self._crew.ready())
        self._room = {drawing.number: drawing.num_rows for drawing in drawings}
        self._own: list[tuple] = []
        self._open: dict[bytes, list[tuple]] = {}
        self._busy = 0  # jobs that the painter has
        self.images = []
        offers = []
        for drawing, poses in zip(drawings, rows, strict=True):
            shape = (len(poses), 3, drawing.image_size, drawing.image_size)
            self.images.append({name: np.empty(shape, np.uint8) for name in drawing.cameras})
            views = zip(*self.images[-1].values(), strict=True)
            jobs = [(drawing.number, pose, places) for pose, places in zip(poses, views, strict=True)]
            if self._helpers and drawing.home != 0 and len(poses) <= self._room[drawing.number]:
                offers.append((drawing, self._share(drawing, jobs)))
            else:
                self._own += jobs
        try:
            for drawing, tickets in offers:
                self._open |= tickets
                if drawing.home is None:
                    self._crew.issue(tickets)
                else:
                    self._helpers[drawing.home - 1].draw(tickets)
        except OSError as error:
            self._give_up(error)
        if not self._helpers and not self._busy:
            self._begin()

    def finish(self) -> list[dict[str, np.ndarray]]:
        """Waits until everything is drawn. Raises the first error."""
        if self._helpers:  # not before: beside the caller's Python, this process would hardly draw
            self._begin()
        error = self._wait()
        try:
            while self._open:
                for ticket in self._crew.reports():
                    self._collect(ticket)
        except OSError as failure:
            self._give_up(failure)
            error = self._wait() or error
        self._pool._frames = None
        if error is not None:
            raise error
        return self.images

    def _share(self, drawing: Drawing, jobs: list[tuple]) -> dict[bytes, list[tuple]]:
        """Puts the poses where helpers see them; the tickets for these rows."""
        shared, room = self._crew.shared[drawing.number], self._room[drawing.number]
        start = drawing.num_rows - room
        self._room[drawing.number] = room - len(jobs)
        for row, (_, pose, _) in enumerate(jobs, start):
            for there, here in zip(shared.pose(row), pose, strict=True):
                there[:] = here
        size = -(-drawing.num_rows * len(self._room) // _MOST_TICKETS)
        parts = {first: jobs[first : first + size] for first in range(0, len(jobs), size)}
        return {RECORD.pack(drawing.number, start + first, len(part)): part for first, part in parts.items()}

    def _begin(self) -> None:
        self._busy += 1
        self._painter.call(self._paint)

    def _wait(self) -> Exception | None:
        errors = []
        while self._busy:
            errors.append(self._painter.wait())
            self._busy -= 1
        return next((error for error in errors if error is not None), None)

    def _paint(self, painter: Painter) -> None:
        started = time.perf_counter()
        own, self._own = self._own, []
        try:
            painter.draw(itertools.chain(own, self._taken()))
        finally:
            self._pool._seconds += time.perf_counter() - started

    def _taken(self) -> Iterator[tuple]:
        """What this process takes of the rows that all may draw."""
        while self._open and (ticket := self._crew.take()) is not None:
            yield from self._open.pop(ticket)

    def _collect(self, ticket: bytes) -> None:
        number, first, count = RECORD.unpack(ticket)
        jobs, images = self._open.pop(ticket), self._crew.shared[number].images
        for row in range(count):
            for image, drawn in zip(jobs[row][2], images, strict=True):
                image[:] = drawn[first + row]

    def _give_up(self, error: OSError) -> None:
        """What the helpers have not drawn is left to this process."""
        self._crew.dismiss(str(error))
        self._helpers.clear()
        self._own += [job for jobs in self._open.values() for job in jobs]
        self._open.clear()
        self._begin()


def _cores() -> int:
    """On how many cores this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _anonymous_file() -> int:
    """A descriptor of a file in memory that has no name, and so ends with those who hold it."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rows")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _stop(painter: Painter, crew: _Crew) -> None:
    crew.dismiss()
    painter.stop()
