"""How speeds are measured: per second, per core-second, and beside yardsticks of the same run.

Machines differ, and so does one machine from hour to hour; what the same core makes of MuJoCo alone, or the same GPU of
a large matrix product, tells how far a figure travels.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import torch
from torch.utils.flop_counter import FlopCounterMode

from worldenv_trl.scenes import Task

_MATMUL = {"cpu": 1024, "cuda": 8192}  # rows and columns


@dataclass(frozen=True)
class Speed:
    """Units of something per second and per core-second, one of each for every repeat."""

    per_second: tuple[float, ...]
    per_core_second: tuple[float, ...]

    @property
    def wall(self) -> float:
        """The median, per second."""
        return statistics.median(self.per_second)

    @property
    def core(self) -> float:
        """The median, per core-second."""
        return statistics.median(self.per_core_second)


def core_seconds(processes: Sequence[int] = ()) -> float:
    """Processor time of this process and, on Linux, of the processes it has started and of ``processes``, by their
    numbers; all threads together."""
    spent = time.process_time()
    tick = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
    started = [child for each in Path("/proc/self/task").glob("*/children") for child in each.read_text().split()]
    for number in {*started, *map(str, processes)}:
        try:
            fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        spent += (int(fields[11]) + int(fields[12])) / tick
    return spent


def finish(device: torch.device) -> None:
    """Waits for what a GPU still has to do."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def speed(
    work: Callable[[], float], repeats: int, device: torch.device | None = None, *, processes: Sequence[int] = ()
) -> Speed:
    """Of ``work``, which returns how many units it did; it is done once more before, uncounted. Others' ``processes``
    that do it count, too: see :func:`core_seconds`."""
    device = torch.device("cpu") if device is None else device
    work()
    finish(device)
    wall, core = [], []
    for _ in range(repeats):
        started, busy = time.perf_counter(), core_seconds(processes)
        done = work()
        finish(device)
        wall.append(done / (time.perf_counter() - started))
        core.append(done / max(core_seconds(processes) - busy, 1e-9))
    return Speed(tuple(wall), tuple(core))


def physics_yardstick(task: Task, repeats: int, steps: int = 400) -> Speed:
    """``mj_step`` alone, one at a time, on the model of a task."""
    model = task.build()
    data = mujoco.MjData(model)

    def work() -> float:
        for _ in range(steps):
            mujoco.mj_step(model, data)
        return steps

    return speed(work, repeats)


def drawing_yardstick(task: Task, camera: str, size_px: int, repeats: int, frames: int = 40) -> Speed:
    """Frames by MuJoCo's own renderer, on the model of a task."""
    model = task.build()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, size_px, size_px) as renderer:

        def work() -> float:
            for _ in range(frames):
                renderer.update_scene(data, camera=camera)
                renderer.render()
            return frames

        return speed(work, repeats)


def matmul_bound(device: torch.device, dtype: torch.dtype, repeats: int, size: int | None = None) -> Speed:
    """FLOP/s of a large square matrix product: what nothing made of matrix products exceeds."""
    size = _MATMUL[device.type] if size is None else size
    first, second = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))

    def work() -> float:
        for _ in range(3):
            first @ second
        return 3 * 2 * size**3

    return speed(work, repeats, device)


def flops(work: Callable[[], object]) -> int:
    """Floating-point operations of the matrix products, convolutions and attentions that ``work`` runs."""
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()
