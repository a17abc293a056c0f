"""A Laplace distribution over action chunks whose steps share one displacement."""

from __future__ import annotations

import math

import torch

from worldenv_trl.policies.laplace import IndependentLaplace


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

    whole_chunks = True

    def __init__(
        self, loc: torch.Tensor, scale: torch.Tensor, event_dims: int = 1, validate_args: bool | None = False
    ) -> None:
        if loc.ndim < 2 or event_dims not in (0, 1, 2):
            raise ValueError(
                f"need loc [*B, C, A] and event_dims 0, 1 or 2, got {list(loc.shape)} and event_dims={event_dims}"
            )
        super().__init__(loc, scale, event_dims, validate_args)

    @property
    def noise_scale(self) -> torch.Tensor:
        """``b``, ``[*B, 1, A]``."""
        return self.scale.mean(-2, keepdim=True) / math.sqrt(self.scale.shape[-2])

    @property
    def variance(self) -> torch.Tensor:
        return (2 * self.noise_scale.square()).expand_as(self.loc)

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        """Of the mean of whole chunks ``[*S, *B, C, A]``, in the shape that ``event_dims`` says."""
        shift, scale = (value - self.loc).mean(-2, keepdim=True), self.noise_scale
        return self._of_event(-shift.abs() / scale - (2 * scale).log())

    def entropy(self) -> torch.Tensor:
        """Of what is sampled, in the shape of :meth:`log_prob`."""
        return self._of_event(1 + (2 * self.noise_scale).log())

    def _of_event(self, each: torch.Tensor) -> torch.Tensor:
        """From ``[*S, *B, 1, A]`` to the shape that was asked for."""
        dims = self.reinterpreted_batch_ndims
        if dims == 2:
            return each.sum((-2, -1))
        each = each.expand(*each.shape[:-2], *self.loc.shape[-2:])
        return each.sum(-1) if dims else each
