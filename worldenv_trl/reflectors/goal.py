"""What a reflector asks of what it sees, told by the instruction's words."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["MAX_WORDS", "Goal"]

MAX_WORDS = 64


class Goal(nn.Module):
    """A vector [n, size] for instructions, int64 [n, L]: linear in the mean of their words, each marked by its place.

    Without the places "the left bowl on the right bowl" would be the same goal as "the right bowl on the left bowl". An
    unknown word says nothing.
    """

    def __init__(self, num_words: int, dim: int, size: int, scale: float) -> None:
        super().__init__()
        self.words = nn.Embedding(num_words, dim, padding_idx=0)
        self.places = nn.Parameter(0.5 * torch.randn(MAX_WORDS, dim))
        self.out = nn.Linear(dim, size)
        nn.init.normal_(self.out.weight, std=scale * dim**-0.5)
        nn.init.zeros_(self.out.bias)
        nn.init.zeros_(self.words.weight.data[1])

    def forward(self, words: Tensor) -> Tensor:
        embedded = self.words(words) * (1 + self.places[: words.shape[1]])
        # Divided by the root, so that long and short instructions start with vectors of the same length.
        return self.out(embedded.sum(1) / (words > 0).sum(1, keepdim=True) ** 0.5)
