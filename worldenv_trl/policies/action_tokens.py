"""Actions as tokens: bins between the bounds of a data set's actions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.data.vla import ActionTokenizerBase, VocabTailActionTokenizer

from worldenv_trl.keys import ACTION_DIM

__all__ = ["QuantileActionTokenizer"]


class QuantileActionTokenizer(ActionTokenizerBase):
    """OpenVLA's codec (TorchRL's ``VocabTailActionTokenizer``) between bounds that can be fitted and are saved.

    A number of an action, brought to [-1, 1] by its bounds and clipped, becomes one of ``num_bins`` tokens: 0 stands
    for the highest edge and beyond, ``num_bins - 1`` for the lowest bin. A token becomes the centre of its bin. It
    computes in float64, as the reference does in NumPy, and on the device of what it is given.

    Args:
        num_bins: edges of the bins; there is one bin less, and the two highest tokens stand for the same one.

    Attributes:
        low, high: what becomes -1 and 1 of each action dimension, float64 [7]; the 1 % and 99 % quantiles of the
            training. ``high`` below ``low`` turns a dimension round.

    Examples:
        >>> tokenizer = QuantileActionTokenizer(256)
        >>> tokens = tokenizer.encode(torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0, 2.0, -2.0]))
        >>> tokens
        tensor([255, 192, 128,  64,   1,   0, 255])
        >>> tokenizer.set_bounds(torch.zeros(7), torch.full((7,), 0.5))
        >>> (tokenizer.decode(tokens) - torch.tensor([0.0, 0.125, 0.25, 0.375, 0.5, 0.5, 0.0])).abs().max() < 0.002
        tensor(True)
    """

    low: Tensor
    high: Tensor

    def __init__(self, num_bins: int = 256) -> None:
        super().__init__()
        self.unit = VocabTailActionTokenizer(num_bins).double()
        edges = torch.linspace(-1.0, 1.0, num_bins, dtype=torch.float64)  # its own are rounded to float32
        self.unit.bins.copy_(edges)
        self.unit.bin_centers.copy_((edges[:-1] + edges[1:]) / 2)
        self.register_buffer("low", -torch.ones(ACTION_DIM, dtype=torch.float64))
        self.register_buffer("high", torch.ones(ACTION_DIM, dtype=torch.float64))

    @property
    def vocab_size(self) -> int:
        return self.unit.vocab_size

    @torch.no_grad()
    def set_bounds(self, low: Tensor | Sequence[float], high: Tensor | Sequence[float]) -> None:
        """Takes new bounds, [7] each."""
        for bound, values in ((self.low, low), (self.high, high)):
            bound.copy_(torch.as_tensor(values, dtype=torch.float64))

    def encode(self, actions: Tensor) -> Tensor:
        """Tokens int64 of actions [..., 7]."""
        span = self.high - self.low + 1e-8
        return self.unit.encode(2 * (actions.double() - self.low) / span - 1)

    def decode(self, tokens: Tensor) -> Tensor:
        """Actions float32 of tokens [..., 7]."""
        unit = self.unit.decode(tokens)
        return (0.5 * (unit + 1) * (self.high - self.low) + self.low).float()
