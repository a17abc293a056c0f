"""Rendering many rows of one or several models on a few threads, one GL context each."""

from __future__ import annotations

import atexit
import importlib
import itertools
import os
import queue
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
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

from worldenv_trl.scenes.canvas import Canvas, Paint  # noqa: E402 - imports MuJoCo, which must have found its GL

Row = tuple[np.ndarray, np.ndarray, np.ndarray]  # qpos [nq], mocap_pos [nmocap, 3], mocap_quat [nmocap, 4]


class RendererPool:
    """Threads with a GL context each, which draw rows of every model that was added.

    Raises:
        RuntimeError: if no GL context can be made; the message says what to install.
    """

    def __init__(self, num_threads: int) -> None:
        self._painters: list[_Painter] = []
        # A GL context is freed on the thread that made it. At exit this must come before MuJoCo ends EGL, whose own
        # exit handler was registered when the first context was made: later ones run earlier.
        self._close = weakref.finalize(self, _stop, self._painters)
        self._close.atexit = False
        for _ in range(max(1, num_threads)):
            self._painters.append(_Painter())
            # One after another: GL loaders are not safe to run side by side.
            self._check(self._painters[-1].wait())
        atexit.register(self._close)
        self._num_models = 0

    def add(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[str],
        image_size: int,
        num_rows: int,
        paint: Paint | None = None,
    ) -> Drawing:
        """What draws rows of ``model``, of which there are ``num_rows`` at most; see :class:`Canvas` for the rest.

        Few rows are left to one thread: each thread that takes part costs memory and time to set up.
        """
        threads = len(self._painters)
        first = self._num_models % threads
        painters = self._painters if num_rows >= 2 * threads else self._painters[first : first + 1]
        self._num_models += 1
        key = object()
        for painter in painters:
            painter.call(lambda p: p.canvases.__setitem__(key, Canvas(model, cameras, image_size, paint)))
            self._check(painter.wait())
        return Drawing(self, key, painters, tuple(cameras), image_size)

    def render(self, drawings: Sequence[Drawing], rows: Sequence[Sequence[Row]]) -> list[dict[str, np.ndarray]]:
        """Draws several models at once: for each, and each camera, ``[len(rows), 3, H, W]`` uint8, upright."""
        return self.start(drawings, rows)()

    def start(
        self, drawings: Sequence[Drawing], rows: Sequence[Sequence[Row]]
    ) -> Callable[[], list[dict[str, np.ndarray]]]:
        """Begins to ``render``; what it returns must be called, waits for the end and gives the images."""
        images, shared = [], []
        alone: dict[_Painter, list] = {painter: [] for painter in self._painters}
        for drawing, states in zip(drawings, rows, strict=True):
            shape = (len(states), 3, drawing.image_size, drawing.image_size)
            images.append({name: np.empty(shape, np.uint8) for name in drawing.cameras})
            jobs = shared if len(drawing.painters) > 1 else alone[drawing.painters[0]]
            jobs += [(drawing.key, state, [v[row] for v in images[-1].values()]) for row, state in enumerate(states)]
        left = iter(shared)  # threads take the next row as they get there: rows do not cost the same
        busy = [painter for painter in self._painters if alone[painter] or shared]
        for painter in busy:
            painter.call(lambda p: p.draw(itertools.chain(alone[p], left)))

        def finish() -> list[dict[str, np.ndarray]]:
            errors = [painter.wait() for painter in busy]
            for error in errors:
                if error is not None:
                    raise error
            return images

        return finish

    def close(self) -> None:
        """Frees the GL contexts."""
        self._close()
        atexit.unregister(self._close)

    def _check(self, error: Exception | None) -> None:
        if error is not None:
            self._close()
            raise RuntimeError(f"no image can be rendered with MUJOCO_GL={_BACKEND!r} ({error}): {_REMEDY}") from error


@dataclass(frozen=True, eq=False)
class Drawing:
    """A model in a pool, with its cameras."""

    pool: RendererPool
    key: object
    painters: Sequence[_Painter]
    cameras: tuple[str, ...]
    image_size: int

    def render(self, rows: Sequence[Row]) -> dict[str, np.ndarray]:
        """For each camera ``[len(rows), 3, H, W]`` uint8, upright."""
        return self.pool.render([self], [rows])[0]


class _Painter:
    """One thread with one GL context, and a canvas for each model on it."""

    def __init__(self) -> None:
        self.canvases: dict[object, Canvas] = {}
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._results: queue.SimpleQueue = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def call(self, job: Callable[[_Painter], object] | None) -> None:
        """Has the thread do ``job``, or end; ``wait`` for its error, or None."""
        self._jobs.put(job)

    def wait(self) -> Exception | None:
        return self._results.get()

    def draw(self, jobs: Iterator[tuple[object, Row, list[np.ndarray]]]) -> None:
        last = None
        for key, row, images in jobs:
            canvas = self.canvases[key]
            if canvas is not last:
                canvas.make_current()
                last = canvas
            canvas.draw(*row, images)

    def _run(self) -> None:
        context = None
        try:
            context = gl_context.GLContext(64, 64)  # the size is of no use: MuJoCo draws into buffers of its own
            context.make_current()
            self._results.put(None)
        except Exception as error:
            self._results.put(error)
        while (job := self._jobs.get()) is not None:
            try:
                job(self)
                self._results.put(None)
            except Exception as error:
                self._results.put(error)
        for canvas in self.canvases.values():
            canvas.close()
        self.canvases.clear()
        if context is not None:
            context.free()


def _stop(painters: list[_Painter]) -> None:
    for painter in painters:
        painter.call(None)
    for painter in painters:
        painter.thread.join()
    painters.clear()
