"""Heads that turn a backbone's hidden states into the parameters of an action chunk."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["MLPResNet"]


class MLPResNet(nn.Module):
    """MLPResNet of OpenVLA-OFT (arXiv:2502.19645): LN-Linear-ReLU, pre-norm residual blocks, LN-Linear.

    Args:
        in_dim: channels of the input, [..., in_dim].
        dim: channels inside.
        out_dim: channels of the output, [..., out_dim].
        blocks: residual blocks.
        out_bias: what the output begins with.
        out_gain: of the last layer's initial weights; the smaller, the less the output depends on the input at first.

    Examples:
        >>> import torch
        >>> MLPResNet(56, 32, 7, 2, out_bias=-3.0, out_gain=0.01)(torch.zeros(5, 8, 56)).shape
        torch.Size([5, 8, 7])
    """

    def __init__(self, in_dim: int, dim: int, out_dim: int, blocks: int, *, out_bias: float, out_gain: float) -> None:
        super().__init__()
        self.norm_in = nn.LayerNorm(in_dim)
        self.linear_in = nn.Linear(in_dim, dim)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, dim), nn.ReLU()) for _ in range(blocks)
        )
        self.norm_out = nn.LayerNorm(dim)
        self.linear_out = nn.Linear(dim, out_dim)
        nn.init.xavier_uniform_(self.linear_out.weight, gain=out_gain)
        nn.init.constant_(self.linear_out.bias, out_bias)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.linear_in(self.norm_in(x)))
        for block in self.blocks:
            x = x + block(x)
        return self.linear_out(self.norm_out(x))
