"""One part at full size: what it costs by count, on the meta device, and by the clock, on a GPU."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from peak_memory import PeakMemory
from speeds import flops, speed


@dataclass(frozen=True)
class Row:
    """A part and its two kinds of work: a call (a decision, a frame, a score) and a step of training.

    ``make`` builds the part with its own dtypes on torch's default device, which is meta or a GPU, in evaluation mode;
    the other functions get what it made. Nothing in them may read a tensor's values: on the meta device there are none.
    """

    name: str
    unit: str
    """What one row of a call's batch is: ``decision``, ``imagined frame``, ``score``."""
    make: Callable[[], nn.Module]
    inputs: Callable[[Any, int], Any]
    """Of that many rows, on the module's device; random or zero."""
    call: Callable[[Any, Any], Any]
    train: Callable[[Any], Iterable[nn.Parameter]]
    """Freezes and prepares (adapters, gradient checkpointing) and returns what learns."""
    loss: Callable[[Any, Any], Tensor]
    compile: Callable[[Any], None] = nn.Module.compile
    """In place; of many equal layers, one by one is quicker than the whole."""
    call_batches: tuple[int, ...] = (1, 8)
    train_batch: int = 4
    units_per_row: int = 1
    """How many units one row is: frames of an imagined chunk."""
    read_again: Callable[[Any], int] = lambda module: 0
    """Bytes of the parameters that a call reads more than once, each time counted but the first."""


@dataclass(frozen=True)
class Work:
    """What one call or one training step takes."""

    batch: int
    flops: int
    peak_bytes: int
    """Of what it allocates beside weights and inputs: activations, and gradients of a training step."""
    read_bytes: int
    """Of the parameters that it reads: all of them, but for a head that learns from what was computed once; those that
    tokens one after the other read again as often."""


@dataclass(frozen=True)
class Costs:
    """A row by count."""

    parameters: int
    weight_bytes: int
    calls: tuple[Work, ...]
    trainable: int
    gradient_bytes: int
    optimizer_bytes: int
    """Two moments of AdamW, in the dtype of what learns."""
    training: Work
    training_weight_bytes: int

    @property
    def training_bytes(self) -> int:
        """All that a training step holds at its peak."""
        return self.training_weight_bytes + self.optimizer_bytes + self.training.peak_bytes


def costs(row: Row) -> Costs:
    """Counts a row on the meta device: nothing is allocated, nothing is computed."""
    with torch.device("meta"):
        module = row.make()
        parameters, weight_bytes = _size(module.parameters())
        again = row.read_again(module)
        once = (_work(row.call, module, row.inputs(module, batch), batch, False) for batch in row.call_batches)
        calls = tuple(replace(work, read_bytes=work.read_bytes + again) for work in once)
        learning = list(row.train(module))
        trainable, gradient_bytes = _size(learning)
        inputs = row.inputs(module, row.train_batch)
        training = _work(lambda *args: row.loss(*args).backward(), module, inputs, row.train_batch, True)
        _, training_weight_bytes = _size(module.parameters())
    return Costs(
        parameters,
        weight_bytes,
        calls,
        trainable,
        gradient_bytes,
        2 * gradient_bytes,
        training,
        training_weight_bytes,
    )


def measured_call(row: Row, module: nn.Module, batch: int, repeats: int = 5) -> float:
    """Seconds of one call on the module's device, the median of the repeats."""
    inputs = row.inputs(module, batch)
    device = next(module.parameters()).device

    def work() -> float:
        row.call(module, inputs)
        return 1.0

    with torch.no_grad():
        work()  # beside the one that speed() leaves uncounted: kernels are chosen, and graphs compiled, in the first
        return 1.0 / speed(work, repeats, device).wall


def measured_training(row: Row, module: nn.Module, repeats: int = 3) -> float:
    """Seconds of one training step, AdamW's included, on the module's device; the module stays prepared for it."""
    learning = list(row.train(module))
    device = learning[0].device
    optimizer = torch.optim.AdamW(learning, lr=1e-5, weight_decay=0.0, fused=device.type == "cuda")
    inputs = row.inputs(module, row.train_batch)

    def work() -> float:
        optimizer.zero_grad()
        row.loss(module, inputs).backward()
        optimizer.step()
        return 1.0

    work()
    return 1.0 / speed(work, repeats, device).wall


def free(device: torch.device) -> None:
    """Gives back what the last row held."""
    torch.compiler.reset()
    empty(device)


def empty(device: torch.device) -> None:
    """Gives back what nobody holds any more."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def _work(call: Callable, module: nn.Module, inputs: Any, batch: int, training: bool) -> Work:
    with torch.set_grad_enabled(training):
        count = flops(lambda: call(module, inputs))
        module.zero_grad(set_to_none=True)
        with PeakMemory() as memory:
            call(module, inputs)
        module.zero_grad(set_to_none=True)
    _, read = _size(parameter for parameter in module.parameters() if memory.met(parameter))
    return Work(batch, count, memory.peak, read)


def _size(tensors: Iterable[Tensor]) -> tuple[int, int]:
    tensors = list(tensors)
    return sum(each.numel() for each in tensors), sum(each.numel() * each.element_size() for each in tensors)
