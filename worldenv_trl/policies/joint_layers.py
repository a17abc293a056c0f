"""Transformer layers of two towers that attend to each other: a vision-language model's, and an action expert's."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["AdaptiveNorm", "JointLayer", "rotate", "sinusoids"]

WAVELENGTH = 10_000.0  # of the rotary positions, in SmolVLA whatever its language model was pretrained with


class AdaptiveNorm(nn.Module):
    """RMS norm whose scale and shift, and a gate for what comes of it, are linear in a condition (pi0.5).

    Args:
        dim: channels of the input, [n, S, dim], and of the condition, [n, dim].
        eps: added to the mean square.
    """

    def __init__(self, dim: int, eps: float) -> None:
        super().__init__()
        self.eps = eps
        self.dense = nn.Linear(dim, 3 * dim)
        nn.init.zeros_(self.dense.weight)

    def forward(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        scale, shift, gate = self.dense(condition)[:, None].float().chunk(3, -1)
        normed = x.float() * torch.rsqrt(x.float().square().mean(-1, keepdim=True) + self.eps)
        return (normed * (1 + scale) + shift).to(x.dtype), gate.to(x.dtype)


class JointLayer(nn.Module):
    """A Llama or Gemma decoder layer of transformers, its attention open to keys and values of another tower.

    The layer's modules, and so the names of its weights, stay; only how they are put together is this class's.

    Args:
        layer: transformers' decoder layer, which is taken apart.
        mode: ``self``, its tokens see each other and what is passed as ``past``; ``cross``, they see ``past`` alone,
            through the layer's own projections; ``keys``, nothing but its keys and values is wanted.
    """

    def __init__(self, layer: Any, mode: str = "self") -> None:
        super().__init__()
        self.mode, self.head_dim = mode, int(layer.self_attn.head_dim)
        self.input_layernorm, self.self_attn = layer.input_layernorm, layer.self_attn
        if mode == "keys":
            del self.self_attn.q_proj, self.self_attn.o_proj
        else:
            self.post_attention_layernorm, self.mlp = layer.post_attention_layernorm, layer.mlp

    def forward(
        self,
        hidden: Tensor,
        positions: Tensor,
        allowed: Tensor,
        past: tuple[Tensor, Tensor] | None = None,
        condition: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The tokens after this layer, [n, S, dim], and their keys and values, [n, heads, S, head_dim].

        Args:
            hidden: tokens, [n, S, dim].
            positions: of these, int64 [n, S].
            allowed: whether a token sees another, bool [n, S, P + S], the past's first, or [n, S, P] in mode ``cross``.
            past: keys and values of the other tower's layer, [n, heads, P, head_dim] each.
            condition: of adaptive norms, [n, dim].
        """
        normed, gate = _normed(self.input_layernorm, hidden, condition)
        attention = self.self_attn
        if self.mode == "cross":
            assert past is not None
            keys, values = (
                self._heads(project(each.transpose(1, 2).flatten(2)))
                for project, each in zip((attention.k_proj, attention.v_proj), past, strict=True)
            )
        else:
            keys, values = self._heads(attention.k_proj(normed)), self._heads(attention.v_proj(normed))
            keys = rotate(keys, positions)
            if self.mode == "keys":
                return hidden, keys, values
        queries = rotate(self._heads(attention.q_proj(normed)), positions)
        seen = keys, values
        if past is not None and self.mode == "self":
            seen = torch.cat([past[0], keys], 2), torch.cat([past[1], values], 2)
        first, second = (each.to(queries.dtype) for each in seen)
        attended = F.scaled_dot_product_attention(queries, first, second, attn_mask=allowed[:, None], enable_gqa=True)
        hidden = hidden + attention.o_proj(attended.transpose(1, 2).flatten(2)) * gate
        normed, gate = _normed(self.post_attention_layernorm, hidden, condition)
        return hidden + self.mlp(normed) * gate, keys, values

    def _heads(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (-1, self.head_dim)).transpose(1, 2)


def _normed(norm: nn.Module, x: Tensor, condition: Tensor | None) -> tuple[Tensor, Tensor | float]:
    return norm(x, condition) if isinstance(norm, AdaptiveNorm) else (norm(x), 1.0)


def rotate(x: Tensor, positions: Tensor) -> Tensor:
    """Rotary positions of heads [n, heads, S, D], the first half of D with the second, at int64 [n, S]."""
    half = x.shape[-1] // 2
    frequency = WAVELENGTH ** (-torch.arange(half, device=x.device, dtype=torch.float32) / half)
    angle = (positions[..., None].float() * frequency)[:, None]  # [n, 1, S, D / 2]
    cosine, sine = angle.cos(), angle.sin()
    first, second = x.float().chunk(2, -1)
    return torch.cat([first * cosine - second * sine, second * cosine + first * sine], -1).to(x.dtype)


def sinusoids(time: float, dim: int, shortest: float, longest: float, device: torch.device) -> Tensor:
    """Sines, then cosines of a time in [0, 1], of periods between these two: float32 [1, dim].

    Examples:
        >>> sinusoids(0.0, 6, 0.5, 1.0, torch.device("cpu"))
        tensor([[0., 0., 0., 1., 1., 1.]])
    """
    return torch.from_numpy(_sinusoids(time, dim, shortest, longest)).to(device)


@functools.lru_cache(maxsize=256)
def _sinusoids(time: float, dim: int, shortest: float, longest: float) -> np.ndarray:
    period = shortest * (longest / shortest) ** np.linspace(0.0, 1.0, dim // 2)
    angle = np.float64(np.float32(time)) * 2 * math.pi / period
    return np.concatenate([np.sin(angle), np.cos(angle)])[None].astype(np.float32)
