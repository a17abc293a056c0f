"""Rendering many rows of one model on a few threads, one GL context each."""

from __future__ import annotations

import atexit
import copy
import importlib
import os
import queue
import threading
import weakref
from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image

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

# Twice the pixels each way and a mean: in software GL cheaper than MuJoCo's four samples a pixel, and unlike those not
# done under a lock that all contexts share, so that two threads draw nearly twice as fast as one.
SUPERSAMPLING = 2

Paint = Callable[[mujoco.MjModel, np.ndarray], None]


class RendererPool:
    """Draws rows of a batch as images.

    Args:
        model: the compiled model; each thread draws its own copy.
        cameras: names of the cameras.
        image_size: height and width (px).
        num_threads: threads, each with one GL context.
        paint: called with a thread's model copy and a row's ``qpos`` before it is drawn, to set colours that depend on
            the state (a burner that glows).

    Raises:
        RuntimeError: if no GL context can be made; the message says what to install.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[str],
        image_size: int,
        num_threads: int,
        paint: Paint | None = None,
    ) -> None:
        self.cameras, self.image_size = tuple(cameras), image_size
        self._painters: list[_Painter] = []
        errors: list[Exception] = []
        for _ in range(max(1, num_threads)):
            painter = _Painter(model, image_size, paint)
            self._painters.append(painter)
            # One after another: GL loaders are not safe to run side by side.
            if (error := painter.wait()) is not None:
                errors.append(error)
                break
        # A GL context is freed on the thread that made it. At exit this must come before MuJoCo ends EGL, whose own
        # exit handler was registered when the first context was made: later ones run earlier.
        self._close = weakref.finalize(self, _stop, self._painters)
        self._close.atexit = False
        atexit.register(self._close)
        if errors:
            self._close()
            raise RuntimeError(
                f"no image can be rendered with MUJOCO_GL={_BACKEND!r} ({errors[0]}): {_REMEDY}"
            ) from errors[0]

    def render(self, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray) -> dict[str, np.ndarray]:
        """Draws rows ``qpos [n, nq]``, ``mocap_pos [n, nmocap, 3]``, ``mocap_quat [n, nmocap, 4]``: for each camera
        ``[n, 3, H, W]`` uint8, upright."""
        size = self.image_size
        images = {name: np.empty((len(qpos), 3, size, size), np.uint8) for name in self.cameras}
        busy = self._painters[: len(qpos)]
        for start, painter in enumerate(busy):
            painter.draw(qpos, mocap_pos, mocap_quat, range(start, len(qpos), len(busy)), images)
        for painter in busy:
            error = painter.wait()
            if error is not None:
                raise error
        return images

    def close(self) -> None:
        """Frees the GL contexts."""
        self._close()


class _Painter:
    """One thread with one GL context."""

    def __init__(self, model: mujoco.MjModel, image_size: int, paint: Paint | None) -> None:
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._results: queue.SimpleQueue = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._run, args=(copy.copy(model), image_size, paint), daemon=True)
        self.thread.start()

    def draw(self, *job: object) -> None:
        self._jobs.put(job)

    def stop(self) -> None:
        self._jobs.put(None)

    def wait(self) -> Exception | None:
        return self._results.get()

    def _run(self, model: mujoco.MjModel, image_size: int, paint: Paint | None) -> None:
        fine = SUPERSAMPLING * image_size
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = fine
        try:
            renderer = mujoco.Renderer(model, fine, fine)
        except Exception as error:
            self._results.put(error)
            return
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        data, frame = mujoco.MjData(model), np.empty((fine, fine, 3), np.uint8)
        self._results.put(None)
        while (job := self._jobs.get()) is not None:
            qpos, mocap_pos, mocap_quat, rows, images = job
            try:
                for row in rows:
                    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos[row], mocap_pos[row], mocap_quat[row]
                    mujoco.mj_kinematics(model, data)
                    mujoco.mj_camlight(model, data)
                    if paint is not None:
                        paint(model, qpos[row])
                    for name, batch in images.items():
                        renderer.update_scene(data, name)
                        batch[row] = _shrunk(renderer.render(out=frame)).transpose(2, 0, 1)
                self._results.put(None)
            except Exception as error:
                self._results.put(error)
        renderer.close()


def _shrunk(frame: np.ndarray) -> np.ndarray:
    """Means of the ``SUPERSAMPLING x SUPERSAMPLING`` blocks of ``[H, W, 3]`` uint8, rounded."""
    image = Image.frombuffer("RGB", frame.shape[1::-1], frame, "raw", "RGB", 0, 1)
    return np.asarray(image.reduce(SUPERSAMPLING))


def _stop(painters: list[_Painter]) -> None:
    for painter in painters:
        painter.stop()
    for painter in painters:
        painter.thread.join()
