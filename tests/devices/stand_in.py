"""A CUDA device for machines without one: tensors that compute on the CPU, say that they are on ``cuda:0`` and refuse
to meet others, as those of a GPU do.

PyTorch's own fake CUDA tensors (``FakeTensorMode``) end the process of a CPU-only build with the first operation that
is differentiated ("PyTorch is not linked with support for cuda devices"), and they have no values, which everything
here that picks rows, stops rollouts or reads texts needs. These have: whole loops run on them.

What differs from a GPU: memory is not another one (crossing devices copies all the same), autocast is off, and one
overridable function is one step: what it does inside is not looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

CUDA = torch.device("cuda", 0)
_inside = 0  # depth of functions at work, which compute on the CPU


class StandInTensor(torch.Tensor):
    """On ``cuda:0``, as far as anyone can see."""

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return torch.device("cpu") if _inside else CUDA

    @property
    def is_cuda(self) -> bool:  # type: ignore[override]
        return not _inside

    @classmethod
    def __torch_function__(cls, func: Callable, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, dict(kwargs or {}))

    def __deepcopy__(self, memo: dict) -> StandInTensor:
        if id(self) not in memo:
            copied = self.detach().clone().requires_grad_(self.requires_grad)
            copied._is_param = getattr(self, "_is_param", False)  # type: ignore[attr-defined]
            memo[id(self)] = copied
        return memo[id(self)]

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy it to the host")


class _Mode(TorchFunctionMode):
    def __torch_function__(self, func: Callable, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        other = next((kind for kind in types if not issubclass(kind, torch.Tensor)), None)
        if other is not None:  # TensorDict, which calls the function again for its tensors
            with self:
                return other.__torch_function__(func, types, args, kwargs)
        return _run(func, args, dict(kwargs or {}))


@contextmanager
def stand_in() -> Iterator[torch.device]:
    """While it lasts, ``cuda`` means such tensors; modules move there and back by ``.to``."""
    before = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # their parameters are of another class there
    try:
        with _Mode():
            yield CUDA
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(before)


_MOVES = (torch.Tensor.to, torch.Tensor.cpu, torch.Tensor.cuda)
_READS = (torch.Tensor.numpy, torch.Tensor.__array__)
_CROSSES = (torch.Tensor.copy_,)  # copies between devices are what it is for


def _run(func: Callable, args: Any, kwargs: dict) -> Any:
    tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, torch.Tensor)]
    there = [each for each in tensors if isinstance(each, StandInTensor)]
    if func in _READS and there:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy it to the host")
    if func is torch._has_compatible_shallow_copy_type:  # modules on the move then make new parameters
        return len(there) in (0, len(tensors))
    if func in _MOVES:
        return _moved(func, args, kwargs)
    if there:
        _check(func, args, kwargs, tensors)
    out_there = bool(there)
    if func is torch.Tensor.__setitem__ or func in _CROSSES:
        out_there = isinstance(args[0], StandInTensor)
    if kwargs.get("device") is not None:
        out_there = torch.device(kwargs["device"]).type == "cuda"
        kwargs["device"] = torch.device("cpu")
        if there and not out_there:
            out_there = False
    out = _plain(func, args, kwargs)
    return _each(_there, out) if out_there else _here(out, tensors)


def _plain(func: Callable, args: Any, kwargs: dict) -> Any:
    global _inside
    _inside += 1
    try:
        with torch._C.DisableTorchFunctionSubclass():
            return func(*args, **kwargs)
    finally:
        _inside -= 1


def _there(tensor: torch.Tensor) -> torch.Tensor:
    if isinstance(tensor, StandInTensor):
        return tensor
    return _plain(torch.Tensor.as_subclass, (tensor, StandInTensor), {})


def _here(out: Any, given: list[torch.Tensor]) -> Any:
    """Results that are not there: an in-place function gives back what it was given."""
    known = {id(each) for each in given}

    def strip(tensor: torch.Tensor) -> torch.Tensor:
        if isinstance(tensor, StandInTensor) and id(tensor) not in known:
            return _plain(torch.Tensor.as_subclass, (tensor, torch.Tensor), {})
        return tensor

    return _each(strip, out)


def _each(change: Callable, out: Any) -> Any:
    """``change`` of the tensors of a result; a torch.Size stays one."""
    if isinstance(out, torch.Tensor):
        return change(out)
    if type(out) in (tuple, list) or type(out).__module__ == "torch.return_types":
        return type(out)([_each(change, value) for value in out])
    return out


def _moved(func: Callable, args: Any, kwargs: dict) -> torch.Tensor:
    """``.to``, ``.cpu`` and ``.cuda``: a copy wherever devices differ."""
    tensor, rest = args[0], list(args[1:])
    was = isinstance(tensor, StandInTensor)
    target: torch.device | None = None
    if func is not torch.Tensor.to:
        target, rest = torch.device("cpu" if func is torch.Tensor.cpu else "cuda"), []
        kwargs.pop("device", None)
    elif "device" in kwargs or "other" in kwargs:
        given = kwargs.pop("device", None) if "device" in kwargs else kwargs.pop("other")
        rest.insert(0, given)
    kept: list[Any] = []
    for index, value in enumerate(rest):
        if index == 0 and isinstance(value, torch.Tensor):
            target = CUDA if isinstance(value, StandInTensor) else torch.device("cpu")
            kept.append(value.dtype)
        elif index == 0 and isinstance(value, (str, int, torch.device)) and not isinstance(value, bool):
            target = torch.device("cuda", value) if isinstance(value, int) else torch.device(value)
        elif value is not None:
            kept.append(value)
    goes = was if target is None else target.type == "cuda"
    if was != goes and not any(isinstance(each, bool) for each in kept):
        kwargs.setdefault("copy", True)
    kwargs.pop("non_blocking", None)
    dtype = next((each for each in kept if isinstance(each, torch.dtype)), kwargs.pop("dtype", None))
    out = _plain(torch.Tensor.to, (tensor, tensor.dtype if dtype is None else dtype), kwargs)
    if goes:
        return _there(out)
    return _plain(torch.Tensor.as_subclass, (out, torch.Tensor), {}) if isinstance(out, StandInTensor) else out


def _check(func: Callable, args: Any, kwargs: dict, tensors: list[torch.Tensor]) -> None:
    """Raises as CUDA does for tensors of two devices; numbers (tensors without dimensions) may come from the CPU."""
    strangers = [each for each in tensors if not isinstance(each, StandInTensor) and each.ndim]
    if not strangers or func in _CROSSES:
        return
    if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
        index = [each for each in tree_leaves(args[1]) if isinstance(each, torch.Tensor)]
        if isinstance(args[0], StandInTensor):  # an index may lie on the CPU
            values = [each for each in tree_leaves(args[2:]) if isinstance(each, torch.Tensor)]
            if not index or not any(each.ndim and not isinstance(each, StandInTensor) for each in values):
                return
        elif not any(isinstance(each, StandInTensor) for each in index) and not index:
            return  # a slice of a CPU tensor is written to by a copy
    name = getattr(func, "__name__", str(func))
    raise RuntimeError(
        f"{name}: expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu! "
        f"(on the CPU: {[tuple(each.shape) for each in strangers]})"
    )
