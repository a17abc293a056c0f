"""Who draws for a :class:`RendererPool`: a thread of this process, and helpers that are processes of their own."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable

import numpy as np
from mujoco.rendering.classic import gl_context

from worldenv_trl.scenes.canvas import Canvas
from worldenv_trl.scenes.shared_rows import RECORD, Layout

Row = tuple[np.ndarray, np.ndarray, np.ndarray]  # qpos [nq], mocap_pos [nmocap, 3], mocap_quat [nmocap, 4]

# The scenes' package loads all of MuJoCo's tools; a helper needs two of its modules, and goes past its __init__.
_BOOT = """
import json, sys, types
sys.path[:] = json.loads(sys.argv[1])
scenes = types.ModuleType("worldenv_trl.scenes")
scenes.__path__ = [sys.argv[2]]
sys.modules[scenes.__name__] = scenes
from worldenv_trl.scenes.painter_process import main
main(int(sys.argv[3]), int(sys.argv[4]))
"""


class Painter:
    """One thread with one GL context, and a canvas for each model on it.

    ``wait`` once after making it: for the error if there is no GL context, or None.
    """

    def __init__(self) -> None:
        self.canvases: dict[int, Canvas] = {}
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._results: queue.SimpleQueue = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def call(self, job: Callable[[Painter], object]) -> None:
        """Has the thread do ``job``; ``wait`` for its error, or None."""
        self._jobs.put(job)

    def wait(self) -> Exception | None:
        return self._results.get()

    def draw(self, jobs: Iterable[tuple[int, Row, list[np.ndarray]]]) -> None:
        """Draws ``jobs``: the number of a model, a pose and where the images go. Raises the first error, at the end."""
        last = error = None
        for number, row, images in jobs:
            canvas = self.canvases[number]
            if canvas is not last:
                canvas.make_current()
                last = canvas
            try:
                canvas.draw(*row, images)
            except Exception as caught:
                error = error or caught
        if error is not None:
            raise error

    def stop(self) -> None:
        """Ends the thread, on which the canvases and the context are freed."""
        self._jobs.put(None)
        self._thread.join()

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


class Helper:
    """A process that draws; see :mod:`worldenv_trl.scenes.painter_process`. Started in the background.

    Args:
        memory: descriptor of the shared file.
        tickets: descriptor of the pipe that brings rows which any painter may draw.

    Raises:
        OSError: if no process can be started.
    """

    def __init__(self, memory: int, tickets: int) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed in ``stop``
        arguments = [json.dumps(sys.path), os.path.dirname(__file__), str(memory), str(tickets)]
        try:
            # Without site-packages' start-up files: the paths are handed over. A session of its own: Ctrl-C is for us.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-S", "-c", _BOOT, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._log,
                bufsize=0,
                pass_fds=(memory, tickets),
                start_new_session=True,
            )
        except BaseException:
            self._log.close()
            raise
        assert self._process.stdin is not None and self._process.stdout is not None  # pipes
        self._orders, self._said = self._process.stdin, self._process.stdout
        self.pid, self.reports = self._process.pid, self._said.fileno()
        self.due = 0  # drawings that it has been given but has not yet reported to hold

    def add(self, layout: Layout) -> None:
        """Gives it a drawing, whose model is in the shared file already. Raises ``OSError`` if the process is gone."""
        self.due += 1
        self._write(layout.to_line())

    def draw(self, records: Iterable[bytes]) -> None:
        """Has it draw these rows. Raises ``OSError`` if the process is gone."""
        self._write(b"".join(record.hex().encode() + b"\n" for record in records))

    def read(self) -> bytes:
        """The next report, waited for. Raises ``OSError`` if the process is gone."""
        if not (report := os.read(self.reports, RECORD.size)):
            raise BrokenPipeError("it is gone")
        return report

    def stop(self, patience: float = 0.0) -> str:
        """Ends the process, which is given ``patience`` (s) to do so itself; what it said last, or how it ended."""
        for file in (self._orders, self._said):
            with contextlib.suppress(OSError):
                file.close()
        try:
            status = self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            status = self._process.wait()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        self._log.close()
        return lines[-1] if lines else f"exit status {status}"

    def _write(self, data: bytes) -> None:
        while data:
            data = data[self._orders.write(data) :]
