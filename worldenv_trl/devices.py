"""Where tensors are: which device a run computes on, where a module is, and how batches get there."""

from __future__ import annotations

from typing import TypeVar

import torch
from tensordict import LazyStackedTensorDict, TensorDictBase, is_non_tensor
from torch import nn

__all__ = ["check_device_name", "choose_device", "device_of", "to_device"]

Batch = TypeVar("Batch", bound=TensorDictBase)


def choose_device(name: str) -> torch.device:
    """The device that ``auto``, ``cpu``, ``cuda`` or ``cuda:N`` names here; ``auto`` is CUDA where there is one.

    Raises:
        ValueError: for another name, or a device that this machine, or this build of PyTorch, does not have.

    Examples:
        >>> choose_device("cpu")
        device(type='cpu')
        >>> choose_device("gpu")
        Traceback (most recent call last):
            ...
        ValueError: device must be auto, cpu, cuda or cuda:N, got 'gpu'
    """
    check_device_name(name)
    _, colon, number = name.partition(":")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        why = "this PyTorch is built without CUDA" if torch.version.cuda is None else "PyTorch finds no GPU"
        raise ValueError(f"device {name!r} does not exist here, {why}: use auto or cpu")
    count = torch.cuda.device_count()
    index = int(number) if colon else torch.cuda.current_device()
    if index >= count:
        known = "cuda:0" if count == 1 else f"cuda:0 to cuda:{count - 1}"
        raise ValueError(f"device {name!r} does not exist, this machine has {known}: use one of these, auto or cpu")
    return torch.device("cuda", index)


def check_device_name(name: str) -> None:
    """Raises ``ValueError`` for what no machine's device is called."""
    kind, colon, number = name.partition(":")
    if not (name in ("auto", "cpu", "cuda") or (kind == "cuda" and colon and number.isascii() and number.isdigit())):
        raise ValueError(f"device must be auto, cpu, cuda or cuda:N, got {name!r}")


def device_of(module: nn.Module, default: torch.device | str = "cpu") -> torch.device:
    """That of the module's first parameter or, without one, buffer; ``default`` for a module that has neither."""
    for values in (module.parameters(), module.buffers()):
        for value in values:
            return value.device
    return torch.device(default)


def to_device(batch: Batch, device: torch.device) -> Batch:
    """``batch`` on ``device``; the very same if its tensors are there, for nothing then."""
    return batch if _where(batch, device) == device else batch.to(device)


def _where(batch: TensorDictBase, default: torch.device) -> torch.device:
    """The device of the first tensor, found without stacking what is stacked lazily."""
    while isinstance(batch, LazyStackedTensorDict) and batch.tensordicts:
        batch = batch.tensordicts[0]
    for value in batch.values():
        if isinstance(value, torch.Tensor):
            return value.device
        if isinstance(value, TensorDictBase) and not is_non_tensor(value) and not value.is_empty():
            return _where(value, default)
    return default
