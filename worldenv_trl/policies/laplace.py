"""Independent Laplace distribution over action chunks."""

from __future__ import annotations

import torch
from torch.distributions import Independent, Laplace
from torch.types import _size

from worldenv_trl.row_share import own_rows

_ONE = torch.Size()  # sample of each distribution


class IndependentLaplace(Independent):
    """Laplace(loc, scale) per dimension; the last ``event_dims`` dimensions are one event.

    World-Env Eq. 2-3: the stochastic policy is ``a ~ Laplace(mu, exp(beta))``, whose likelihood is maximised by the
    L1 regression that trains ``mu``. With ``loc`` ``[*B, C, A]``, ``log_prob`` has shape ``[*B, C]`` for
    ``event_dims=1`` (one ratio per step), ``[*B]`` for 2 (per chunk) and ``[*B, C, A]`` for 0.

    Args:
        loc: mean, median and mode, in normalised action units.
        scale: mean absolute deviation, positive, broadcastable to ``loc``.
        event_dims: number of trailing dimensions that are summed in ``log_prob`` and ``entropy``.

    Examples:
        >>> distribution = IndependentLaplace(torch.zeros(5, 8, 7), torch.full((7,), 0.1))
        >>> distribution.log_prob(distribution.sample()).shape
        torch.Size([5, 8])
    """

    whole_chunks = False  # whether what is scored is the chunk as a whole, also where it was executed in part

    def __init__(
        self,
        loc: torch.Tensor,
        scale: torch.Tensor,
        event_dims: int = 1,
        validate_args: bool | None = False,
    ):
        super().__init__(Laplace(loc, scale, validate_args=validate_args), event_dims, validate_args=validate_args)

    @torch.no_grad()
    def sample(self, sample_shape: _size = _ONE) -> torch.Tensor:
        """See :meth:`rsample`; without a gradient."""
        return self.rsample(sample_shape)

    def rsample(self, sample_shape: _size = _ONE) -> torch.Tensor:
        """Reparametrised samples ``[*sample_shape, *B, C, A]``; of rows shared by processes see
        :func:`~worldenv_trl.row_share.row_share`."""
        loc, scale = self.loc, self.noise_scale
        if sample_shape or not loc.ndim:
            return loc + scale * Laplace(torch.zeros_like(scale), torch.ones_like(scale)).rsample(sample_shape)
        unit = Laplace(torch.zeros_like(scale[:1]), torch.ones_like(scale[:1]))  # of one row
        return loc + scale * own_rows(lambda count: unit.rsample(torch.Size([count])).squeeze(1), len(scale))

    @property
    def loc(self) -> torch.Tensor:
        return self.base_dist.loc

    @property
    def scale(self) -> torch.Tensor:
        return self.base_dist.scale

    @property
    def noise_scale(self) -> torch.Tensor:
        """Mean absolute deviation of what is drawn for a sample, broadcastable to ``loc``: here ``scale``."""
        return self.scale

    @property
    def deterministic_sample(self) -> torch.Tensor:
        """What TorchRL takes under ``ExplorationType.DETERMINISTIC``: the mode."""
        return self.base_dist.loc
