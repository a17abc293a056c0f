"""Random numbers of a batch whose rows several processes share: each draws for all rows and keeps those of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from torch import Tensor

__all__ = ["own_items", "own_rows", "row_share"]

Item = TypeVar("Item")

_SHARE: ContextVar[tuple[int, int]] = ContextVar("row_share", default=(0, 1))


@contextmanager
def row_share(rank: int, size: int) -> Iterator[None]:
    """While it lasts, batches at hand are the ``rank``-th of ``size`` equal shares of a larger one.

    With the same random state in all processes, they together draw what one process would for the whole batch, and
    their random states stay the same.

    Args:
        rank: of this process, from 0.
        size: processes; 1 changes nothing.

    Raises:
        ValueError: unless ``0 <= rank < size``.

    Examples:
        >>> import torch
        >>> whole = torch.rand(4, generator=torch.Generator().manual_seed(0))
        >>> with row_share(1, 2):
        ...     mine = own_rows(lambda count: torch.rand(count, generator=torch.Generator().manual_seed(0)), 2)
        >>> torch.equal(mine, whole[2:])
        True
    """
    if not 0 <= rank < size:
        raise ValueError(f"rank must be in [0, {size}), got {rank}")
    token = _SHARE.set((rank, size))
    try:
        yield
    finally:
        _SHARE.reset(token)


def own_rows(draw: Callable[[int], Tensor], count: int, dim: int = 0) -> Tensor:
    """Random numbers for the ``count`` rows of this process: its share of ``draw(rows of all processes)``.

    Args:
        draw: from a number of rows to random numbers, rows in dimension ``dim``.
    """
    rank, size = _SHARE.get()
    return draw(count) if size == 1 else draw(size * count).narrow(dim, rank * count, count)


def own_items(draw: Callable[[int], Sequence[Item]], count: int) -> Sequence[Item]:
    """As :func:`own_rows`, of a list."""
    rank, size = _SHARE.get()
    return draw(count) if size == 1 else draw(size * count)[rank * count : (rank + 1) * count]
