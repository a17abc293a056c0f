"""A Laplace distribution over action chunks whose steps share one displacement."""

from __future__ import annotations

import math

import torch
from torch.distributions import Laplace
from torch.types import _size

from worldenv_trl.policies.laplace import IndependentLaplace
from worldenv_trl.row_share import own_rows

_ONE = torch.Size()


class ChunkLaplace(IndependentLaplace):
    r"""All steps of a chunk are displaced alike, ``a_t = loc_t + n`` with ``n ~ Laplace(0, b)`` for each action
    dimension,

    .. math:: b = \frac{1}{C \sqrt{C}} \sum_t \mathrm{scale}_t,

    so that a chunk moves the hand as far astray as under :class:`IndependentLaplace` of the same scale, whose ``C``
    draws a dimension mostly cancel. The ``7 (C - 1)`` other directions, in which a sampled chunk says nothing of where
    the hand ends and each gradient is noise, are neither sampled nor scored.

    What is scored is the mean of the chunk, as the sum of ``log Laplace(mean_t(a_t - loc_t); 0, b)`` over the action
    dimensions. The ratio of two policies is exact where they differ by the same shift at every step; what else they
    differ by is left out. A chunk counts whole, also one that was executed in part. World-Env draws each step by
    itself (Eq. 2); noise that stays the same over several steps is gSDE's idea (arXiv 2005.05719).

    Args:
        loc: ``[*B, C, A]``, mean, median and mode, in normalised action units.
        scale: positive, of the single steps, broadcastable to ``loc``.
        event_dims: 1: the chunk's log-probability at every step, ``[*B, C]``; 0: of each dimension, ``[*B, C, A]``; 2:
            once, ``[*B]``.

    Raises:
        ValueError: for ``loc`` of fewer than two dimensions, or other ``event_dims``.

    Examples:
        >>> distribution = ChunkLaplace(torch.zeros(5, 8, 7), torch.full((7,), 0.1))
        >>> chunk = distribution.sample()
        >>> bool((chunk == chunk[:, :1]).all()), distribution.log_prob(chunk).shape
        (True, torch.Size([5, 8]))
    """

    def __init__(
        self, loc: torch.Tensor, scale: torch.Tensor, event_dims: int = 1, validate_args: bool | None = False
    ) -> None:
        if loc.ndim < 2 or event_dims not in (0, 1, 2):
            raise ValueError(
                f"need loc [*B, C, A] and event_dims 0, 1 or 2, got {list(loc.shape)} and event_dims={event_dims}"
            )
        super().__init__(loc, scale, event_dims, validate_args)
        self._event_dims = event_dims

    @property
    def shift_scale(self) -> torch.Tensor:
        """``b``, ``[*B, 1, A]``."""
        return self.scale.mean(-2, keepdim=True) / math.sqrt(self.scale.shape[-2])

    @property
    def variance(self) -> torch.Tensor:
        return (2 * self.shift_scale.square()).expand_as(self.loc)

    def rsample(self, sample_shape: _size = _ONE) -> torch.Tensor:
        """See :meth:`IndependentLaplace.rsample`."""
        scale = self.shift_scale
        if sample_shape or scale.ndim == 2:
            return self.loc + scale * Laplace(torch.zeros_like(scale), torch.ones_like(scale)).rsample(sample_shape)
        unit = Laplace(torch.zeros_like(scale[:1]), torch.ones_like(scale[:1]))  # of one row
        return self.loc + scale * own_rows(lambda count: unit.rsample(torch.Size([count])).squeeze(1), len(scale))

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        shift = (value - self.loc).mean(-2, keepdim=True)
        scale = self.shift_scale
        return self._of_event(-shift.abs() / scale - (2 * scale).log())

    def entropy(self) -> torch.Tensor:
        """Of what is sampled, in the shape of :meth:`log_prob`."""
        return self._of_event(1 + (2 * self.shift_scale).log())

    def _of_event(self, each: torch.Tensor) -> torch.Tensor:
        """From ``[*S, *B, 1, A]`` to the shape that was asked for."""
        each = each.expand(*each.shape[:-2], *self.loc.shape[-2:])
        return each if not self._event_dims else each.sum(-1) if self._event_dims == 1 else each[..., 0, :].sum(-1)
