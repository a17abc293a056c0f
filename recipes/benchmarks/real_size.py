"""Full-size parts: parameters, memory, FLOPs, lower bounds on GPUs, and measured seconds where there is one.

``python recipes/benchmarks/real_size.py [--rows policy] [--device cuda] [--compile]``. Everything is built on the meta
device, which takes no memory; with ``--device cuda`` each row is then built there, too, with random weights, and timed.
A bound is the larger of FLOPs over the peak rate and the bytes of the weights over the memory's; nothing is faster.
A row that fails says so in one line, and the others are counted.
"""

from __future__ import annotations

import importlib
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

import torch
import tyro
from torch import nn

from command_line import refusals
from gpus import GPU, GPUS
from real_size_row import Costs, Row, Work, costs, empty, free, measured_call, measured_training
from speeds import matmul_bound
from worldenv_trl.devices import choose_device

Result = TypeVar("Result")

FAMILIES = {"policy": "real_size_policy", "models": "real_size_models"}
"""By the name of the part: the module of the recipes whose ``ROWS`` are its rows."""


@dataclass(frozen=True)
class Benchmark:
    """What is counted and measured."""

    rows: tuple[str, ...] = ()
    """Names of rows, or what they begin with (``policy``); empty: all."""
    device: str = "meta"
    """``meta`` counts alone; ``cuda`` or ``cuda:N`` measures, too; ``cpu`` does that for small rows."""
    compile: bool = False
    """Measures with ``torch.compile`` as well."""
    training: bool = True
    """Measures training steps, too."""


def chosen(names: tuple[str, ...]) -> list[Row]:
    """The rows of these names.

    Raises:
        ValueError: for a name that no row begins with.
    """
    rows = [row for module in FAMILIES.values() for row in importlib.import_module(module).ROWS]
    for name in names:
        if not any(row.name.startswith(name) for row in rows):
            raise ValueError(f"--rows: no row begins with {name!r}; there are {', '.join(row.name for row in rows)}")
    return [row for row in rows if not names or any(row.name.startswith(name) for name in names)]


def main(settings: Benchmark) -> None:
    with refusals():
        rows = chosen(settings.rows)
        device = torch.device("meta") if settings.device == "meta" else choose_device(settings.device)
    for gpu in GPUS:
        print(f"{gpu.name}: {gpu.bf16_flops / 1e12:.0f} TFLOP/s, {gpu.bandwidth / 1e12:.2f} TB/s; {gpu.source}")
    gpu = None
    if device.type != "meta":
        rate = matmul_bound(device, torch.bfloat16, 3).wall
        named = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
        gpu = next((each for each in GPUS if each.name in named), None)
        print(f"measured on {named}, torch {torch.__version__}: a large matrix product {rate / 1e12:.1f} TFLOP/s")
    for row in rows:
        started = time.monotonic()
        counted = _guarded(row, partial(_count, row))
        if counted is not None and device.type != "meta":
            for mode in ("eager", "compiled") if settings.compile else ("eager",):
                _guarded(row, partial(_measure, row, counted, device, gpu, mode, settings.training))
                free(device)
        print(f"  ({time.monotonic() - started:.0f} s)", flush=True)


def _guarded(row: Row, work: Callable[[], Result]) -> Result | None:
    try:
        return work()
    except Exception as error:  # whatever a library raises: the other rows are still worth having
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = str(error).strip().splitlines() or [""]
        print(f"  {row.name} FAILED: {type(error).__name__}: {text[0]} ({where.filename}:{where.lineno})", flush=True)
        return None


def _count(row: Row) -> Costs:
    counted = costs(row)
    print(f"{row.name}: {counted.parameters / 1e6:,.0f} M parameters, {_gb(counted.weight_bytes)}", flush=True)
    for work in counted.calls:
        units = work.batch * row.units_per_row
        print(
            f"  {row.unit}, batch {work.batch}: {work.flops / units / 1e12:.3f} TFLOP each, activations "
            f"{_gb(work.peak_bytes)}; bound {_bounds(work, units)} s each"
        )
    work = counted.training
    print(
        f"  training step, batch {work.batch}: {counted.trainable / 1e6:,.1f} M trainable, {work.flops / 1e12:.2f} "
        f"TFLOP; weights {_gb(counted.training_weight_bytes)}, optimiser {_gb(counted.optimizer_bytes)}, gradients and "
        f"activations {_gb(work.peak_bytes)}: {_gb(counted.training_bytes)}, fits "
        f"{', '.join(each.name for each in GPUS if each.memory >= counted.training_bytes) or 'none'}; "
        f"bound {_bounds(work, 1)} s",
        flush=True,
    )
    return counted


def _bounds(work: Work, units: int) -> str:
    return ", ".join(f"{gpu.name} {gpu.bound(work.flops, work.read_bytes) / units:.4f}" for gpu in GPUS)


def _measure(row: Row, counted: Costs, device: torch.device, gpu: GPU | None, mode: str, training: bool) -> None:
    with torch.device(device):
        module = row.make()
    if mode == "compiled":
        torch._dynamo.config.recompile_limit = 64  # a graph for each kind of layer, batch and mode, of a fixed shape
        row.compile(module)
    for work in counted.calls:
        _guarded(row, partial(_measure_call, row, module, work, device, gpu, mode))
        empty(device)
    if training:
        _guarded(row, partial(_measure_training, row, module, counted, device, gpu, mode))


def _measure_call(row: Row, module: nn.Module, work: Work, device: torch.device, gpu: GPU | None, mode: str) -> None:
    units = work.batch * row.units_per_row
    seconds = measured_call(row, module, work.batch)
    share = _share(seconds, work, gpu)
    print(
        f"  measured {row.unit}, batch {work.batch}, {mode}: {seconds / units:.4f} s each{share}{_peak(device)}",
        flush=True,
    )


def _measure_training(
    row: Row, module: nn.Module, counted: Costs, device: torch.device, gpu: GPU | None, mode: str
) -> None:
    work = counted.training
    seconds = measured_training(row, module)
    share = _share(seconds, work, gpu)
    print(f"  measured training step, batch {work.batch}, {mode}: {seconds:.4f} s{share}{_peak(device)}", flush=True)


def _share(seconds: float, work: Work, gpu: GPU | None) -> str:
    rate = f", {work.flops / seconds / 1e12:.1f} TFLOP/s"
    return (
        rate if gpu is None else f"{rate}, {gpu.bound(work.flops, work.read_bytes) / seconds:.0%} of {gpu.name}'s bound"
    )


def _peak(device: torch.device) -> str:
    """What was held at most since this was asked last."""
    if device.type != "cuda":
        return ""
    peak = torch.cuda.max_memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    return f", peak {_gb(peak)}"


def _gb(size: float) -> str:
    return f"{size / 1e9:.2f} GB"


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
