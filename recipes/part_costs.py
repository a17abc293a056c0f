"""What the parts of a run cost, by count: each is built and called once, at full size on the meta device."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import flop_registry

from peak_memory import PeakMemory, fused_attention


@dataclass(frozen=True)
class Call:
    """One kind of work of a part."""

    flops: float
    """Of a row."""
    activation_bytes: float
    """That live at one time, of a row; no gradients of parameters."""
    read_bytes: float = 0.0
    """Parameters that the modules of a call read, whatever its rows; twice if they are run twice."""


@dataclass(frozen=True)
class Size:
    """Parameters of a part, and which of them learn."""

    parameters: int
    weight_bytes: int
    trainable: int
    gradient_bytes: int
    layer_bytes: int
    """Of the largest layer: what a GPU gathers at a time where weights are sharded."""

    @property
    def optimizer_bytes(self) -> int:
        """AdamW's two moments."""
        return 2 * self.gradient_bytes


def size(module: nn.Module, learning: Iterable[nn.Parameter] | None = None) -> Size:
    """Of a part; ``learning`` are those that learn, all that want gradients by default."""
    learning = [each for each in module.parameters() if each.requires_grad] if learning is None else list(learning)
    parameters = list(module.parameters())
    return Size(
        parameters=sum(each.numel() for each in parameters),
        weight_bytes=_bytes(parameters),
        trainable=sum(each.numel() for each in learning),
        gradient_bytes=_bytes(learning),
        layer_bytes=max((_bytes(layer.parameters()) for layer in _layers(module)), default=0),
    )


def counted(module: nn.Module, rows: int, work: Callable[[], object], *, training: bool = False) -> Call:
    """What ``work``, of that many rows, costs. Products, convolutions and attentions count; attention holds no matrix.

    With ``training`` each parameter's gradient is dropped when it is there: :class:`Size` has them.
    """
    read = 0

    def note(layer: nn.Module, _: object) -> None:
        nonlocal read
        read += _bytes(layer.parameters(recurse=False))

    hooks = [layer.register_forward_pre_hook(note) for layer in module.modules()]
    learning = [each for each in module.parameters() if training and each.requires_grad]
    hooks += [each.register_post_accumulate_grad_hook(_drop_gradient) for each in learning]
    try:
        with torch.set_grad_enabled(training), fused_attention(), _Counter() as counter:
            work()
    finally:
        for hook in hooks:
            hook.remove()
    return Call(counter.flops / rows, counter.peak / rows, read)


class _Counter(PeakMemory):
    """Operations, too, in the same pass: torch's own counter keeps activations alive, which would all be counted."""

    flops = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        out = super().__torch_dispatch__(func, types, args, kwargs)
        count = flop_registry.get(func._overloadpacket)
        if count is not None:
            self.flops += count(*args, **(kwargs or {}), out_val=out)
        return out


def _layers(module: nn.Module) -> Iterable[nn.Module]:
    """Those of stacks of layers, and what stands beside them."""
    for child in module.children():
        if isinstance(child, nn.ModuleList) and len(child):
            yield from child
        elif any(isinstance(each, nn.ModuleList) for each in child.modules()):
            yield from _layers(child)
        else:
            yield child


def _drop_gradient(parameter: Tensor) -> None:
    parameter.grad = None


def _bytes(tensors: Iterable[Tensor]) -> int:
    return sum(each.numel() * each.element_size() for each in tensors)
