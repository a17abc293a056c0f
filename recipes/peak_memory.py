"""Memory that a computation takes, counted on the meta device."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class PeakMemory(TorchDispatchMode):
    """The most bytes that tensors made inside it held at one time, by their storages' sizes and lives.

    On the meta device attention is decomposed and its matrix counted; a fused kernel of a GPU holds none.
    """

    def __init__(self) -> None:
        super().__init__()
        self.peak = self._held = 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        for before in tree_leaves((args, kwargs)):
            if isinstance(before, Tensor):
                self._known.add(before.untyped_storage()._cdata)  # made outside, or counted
        out = func(*args, **(kwargs or {}))
        for after in tree_leaves(out):
            if isinstance(after, Tensor):
                self._count(after.untyped_storage())
        return out

    def met(self, tensor: Tensor) -> bool:
        """Whether an operation has read it, or a view of it."""
        return tensor.untyped_storage()._cdata in self._known

    def _count(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()
        if key in self._known:
            return
        self._known.add(key)
        self._held += size
        self.peak = max(self.peak, self._held)
        weakref.finalize(storage, self._release, key, size)

    def _release(self, key: int, size: int) -> None:
        self._held -= size
        self._known.discard(key)


@contextmanager
def fused_attention() -> Iterator[None]:
    """Attention on the meta device as a GPU's fused kernels have it, which hold no matrix of all with all; it is
    decomposed otherwise.

    The function is replaced for a while: a mode of torch's is not there when checkpoints are computed again.
    """
    plain = F.scaled_dot_product_attention

    def attend(query: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        return (_fused if query.device.type == "meta" else plain)(query, *args, **kwargs)

    F.scaled_dot_product_attention = attend
    try:
        yield
    finally:
        F.scaled_dot_product_attention = plain


def _fused(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    attn_mask: Tensor | None = None,
    dropout_p: float = 0.0,
    is_causal: bool = False,
    scale: float | None = None,
    enable_gqa: bool = False,
) -> Tensor:
    """[..., heads, S, D]."""
    if enable_gqa:
        key, value = (each.repeat_interleave(query.shape[-3] // each.shape[-3], -3) for each in (key, value))
    shape = query.shape
    query, key, value = (
        each.reshape(-1, *each.shape[-3:]) if each.ndim > 3 else each[None] for each in (query, key, value)
    )
    bias = None
    if attn_mask is not None:
        bias = attn_mask.to(query.dtype).expand(*query.shape[:2], query.shape[-2], key.shape[-2])
    out = torch.ops.aten._scaled_dot_product_efficient_attention(
        query, key, value, bias, torch.is_grad_enabled(), dropout_p, is_causal, scale=scale
    )[0]
    return out.reshape(*shape[:-1], value.shape[-1])
