"""The processes of one run: ``torchrun --nproc-per-node K recipes/world_env.py ...``, or one, without torchrun.

What can be shared (SFT, world model, reflector, LOOP) every process does its share of; the rest is the main one's, the
others wait. Processes take the same decisions because the main one takes them (:func:`agreed`) and draw the same random
numbers because they begin alike. Outside torchrun nothing here does anything.
"""

from __future__ import annotations

import atexit
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import timedelta
from typing import Any, NoReturn, TypeVar

import torch
import torch.distributed as dist
from tensordict import TensorDictBase
from torch.distributed.distributed_c10d import _get_default_store

from worldenv_trl.row_share import row_share

Value = TypeVar("Value")
Rows = TypeVar("Rows", bound=TensorDictBase)

_PATIENCE = 5.0  # seconds in which the main process says what is wrong
TIMEOUT = timedelta(days=2)
"""Longer than any stage of the main process. torchrun ends the others as soon as one has failed."""
NEEDED = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
_alone = False


class FailedElsewhere(RuntimeError):
    """The main process has failed, and says why."""


# --------------------------------------------------------------------------------------------------- who takes part


def join(device: str) -> str:
    """Meets the other processes that torchrun has started, if there are any; later calls only name the device.

    Args:
        device: setting of the run; ``auto`` and ``cuda`` are the GPU of this process's number on its machine.

    Returns:
        The setting for this process.

    Raises:
        ValueError: for a device with a number, more processes than GPUs, or an incomplete environment.
    """
    if os.environ.get("WORLD_SIZE", "1") == "1":
        return device
    problem = _problem(device)
    if problem is not None:
        if os.environ.get("RANK", "0") != "0":  # one of them says it
            end_quietly()
        raise ValueError(problem)
    local = int(os.environ["LOCAL_RANK"])
    on_gpu = device != "cpu" and torch.cuda.is_available()
    if not dist.is_initialized():
        if on_gpu:
            torch.cuda.set_device(local)
        dist.init_process_group("cpu:gloo,cuda:nccl" if on_gpu else "gloo", timeout=TIMEOUT)
        atexit.register(leave)
        if dist.get_rank():
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - for as long as the process lives
    return f"cuda:{local}" if on_gpu else device


def _problem(device: str) -> str | None:
    count = os.environ["WORLD_SIZE"]
    missing = [name for name in NEEDED if not os.environ.get(name)]
    if missing:
        return (
            f"WORLD_SIZE={count} asks for several processes, but {', '.join(missing)} is not set: start them with "
            "torchrun --nproc-per-node K recipes/..., or unset WORLD_SIZE"
        )
    if device not in ("auto", "cpu", "cuda"):
        return f"each process takes the GPU of its own number: device must be auto, cpu or cuda, got {device!r}"
    here, gpus = int(os.environ.get("LOCAL_WORLD_SIZE", count)), torch.cuda.device_count()
    if device == "cuda" and not gpus:
        return "device 'cuda' does not exist here: use auto or cpu"
    if device != "cpu" and 0 < gpus < here:
        return f"{here} processes were started on a machine of {gpus} GPUs: --nproc-per-node {gpus}, or --device cpu"
    return None


def end_quietly() -> NoReturn:
    """Ends a process whose error the main one tells, a little later: torchrun ends all when the first has failed."""
    time.sleep(_PATIENCE)
    raise SystemExit(1)


def leave() -> None:
    """Ends the meeting."""
    if dist.is_initialized():
        dist.destroy_process_group()


def size() -> int:
    """How many processes share the work at hand."""
    return dist.get_world_size() if dist.is_initialized() and not _alone else 1


def rank() -> int:
    return dist.get_rank() if dist.is_initialized() and not _alone else 0


def is_main() -> bool:
    """Whether this process writes and speaks for all."""
    return rank() == 0


@contextmanager
def alone() -> Iterator[None]:
    """While it lasts this process does what it does without the others."""
    global _alone
    before, _alone = _alone, True
    try:
        yield
    finally:
        _alone = before


def speaks_first() -> bool:
    """Whether no other process has asked this before: of an error that all meet, one tells."""
    if size() == 1:
        return True
    try:
        return _get_default_store().add("worldenv_trl/spoken", 1) == 1
    except RuntimeError:  # whoever kept the store is gone
        return is_main()


# --------------------------------------------------------------------------------------------------- together


def barrier() -> None:
    """Waits until all are here."""
    agreed(None)


def agreed(value: Value) -> Value:
    """The main process's value, in all."""
    if size() == 1:
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


def on_main(work: Callable[[], Value]) -> Value:
    """What ``work`` gives in the main process, while the others wait; all go on with its random numbers.

    Raises:
        FailedElsewhere: in the others, if it fails.
    """
    if size() == 1:
        return work()
    done: tuple[Any] | None = None
    try:
        if is_main():
            with alone():
                done = (work(),)
    finally:
        done = agreed(done)
    if done is None:
        raise FailedElsewhere("the main process has failed")
    same_random_state()
    return done[0]


@contextmanager
def main_first() -> Iterator[None]:
    """The main process does it before the others: what it leaves on the disk they find there."""
    if not is_main():
        barrier()
    yield
    if is_main():
        barrier()


def total(value: torch.Tensor) -> torch.Tensor:
    """The sum over the processes of a tensor, elementwise."""
    if size() == 1:
        return value
    value = value.clone()
    dist.all_reduce(value)
    return value


def mean(value: torch.Tensor, weight: torch.Tensor | float) -> torch.Tensor:
    """Of a scalar of each process, which weighs so much; detached."""
    value = value.detach()
    if size() == 1:
        return value
    weight = torch.as_tensor(weight, dtype=value.dtype, device=value.device)
    weighted, weights = total(torch.stack([value * weight, weight])).unbind()
    return weighted / weights.clamp_min(1e-12)


def gathered(rows: torch.Tensor) -> torch.Tensor:
    """Rows of all processes, in their order: ``[K * n, ...]`` of ``[n, ...]``, as many in each."""
    if size() == 1:
        return rows
    sent = rows.byte() if rows.dtype == torch.bool else rows.contiguous()
    parts = [torch.empty_like(sent) for _ in range(size())]
    dist.all_gather(parts, sent)
    return torch.cat(parts).to(rows.dtype)


def gathered_values(value: Value) -> list[Value]:
    """Of all processes, in their order."""
    if size() == 1:
        return [value]
    values: list[Any] = [None] * size()
    dist.all_gather_object(values, value)
    return values


def dealt(parts: list[Value] | None) -> Value:
    """To each process its own of the main one's parts."""
    if size() == 1:
        assert parts is not None
        return parts[0]
    box: list[Any] = [None]
    dist.scatter_object_list(box, parts if is_main() else None, src=0)
    return box[0]


# --------------------------------------------------------------------------------------------------- shares of batches


def sharing() -> AbstractContextManager[None]:
    """While it lasts, random numbers of rows are this process's share of those of the whole batch."""
    return row_share(rank(), size())


def own_share(batch: Rows) -> Rows:
    """This process's rows of a batch that all have drawn; the shares differ by one row at most."""
    return batch if size() == 1 else batch.tensor_split(size())[rank()]


def own_rows_of(values: torch.Tensor) -> torch.Tensor:
    """This process's rows of what :func:`gathered` gave, or of what was computed from it."""
    return values if size() == 1 else values.tensor_split(size())[rank()]


def same_random_state(source: int = 0) -> None:
    """All go on with torch's random numbers where process ``source`` is."""
    if size() == 1:
        return
    states = [torch.get_rng_state()]
    if torch.cuda.is_initialized():
        states.append(torch.cuda.get_rng_state())
    box: list[Any] = [states]
    dist.broadcast_object_list(box, src=source)
    torch.set_rng_state(box[0][0])
    if torch.cuda.is_initialized():
        torch.cuda.set_rng_state(box[0][1])
