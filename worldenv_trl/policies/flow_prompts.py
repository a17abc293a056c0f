"""Texts of flow-matching policies as tokens, in the words of each kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from tokenizers import Tokenizer

__all__ = ["Prompts", "state_digits"]

BINS = 256  # of each number of proprioception in pi0.5's prompt, over [-1, 1]


class Prompts:
    """What the vision-language model reads of an instruction: token ids, and which are no padding.

    Args:
        kind: ``smolvla`` and ``pi0`` read a line that is the instruction, ``pi05`` proprioception as digits, too.
        tokenizer: of the vision-language model.
        max_tokens: what is longer is cut.
    """

    def __init__(self, kind: str, tokenizer: Tokenizer, max_tokens: int) -> None:
        self.kind, self.tokenizer, self.max_tokens = kind, tokenizer, max_tokens
        tokenizer.no_padding()
        tokenizer.no_truncation()
        self._ids: dict[str, list[int]] = {}

    @torch.compiler.disable  # texts are no tensors: a compiled graph would be made anew for each mixture of them
    def __call__(self, instructions: Sequence[str], proprio: Tensor) -> tuple[Tensor, Tensor]:
        """Token ids, int64 [n, L], and which are no padding, bool [n, L]; padded behind.

        Args:
            instructions: n texts.
            proprio: normalised, [n, 7] or [n, 8].
        """
        rows = [self._tokens(text) for text in self.texts(instructions, proprio)]
        length = max(map(len, rows))
        ids = torch.tensor([[*row, *[0] * (length - len(row))] for row in rows], device="cpu")
        valid = torch.tensor([[True] * len(row) + [False] * (length - len(row)) for row in rows], device="cpu")
        return ids.to(proprio.device), valid.to(proprio.device)

    def texts(self, instructions: Sequence[str], proprio: Tensor) -> list[str]:
        """What is tokenised."""
        if self.kind != "pi05":
            return [text if text.endswith("\n") else f"{text}\n" for text in instructions]
        tasks = (text.strip().replace("_", " ").replace("\n", " ") for text in instructions)
        return [
            f"Task: {task}, State: {' '.join(map(str, digits))};\nAction: "
            for task, digits in zip(tasks, state_digits(proprio), strict=True)
        ]

    def _tokens(self, text: str) -> list[int]:
        if self.kind == "pi05":  # no two states are the same
            return list(self.tokenizer.encode(text).ids[: self.max_tokens])
        if text not in self._ids:
            self._ids[text] = self.tokenizer.encode(text).ids[: self.max_tokens]
        return self._ids[text]


def state_digits(proprio: Tensor) -> list[list[int]]:
    """The bins of normalised proprioception [n, D]: -1 below the first one, 255 in the last and above.

    Examples:
        >>> state_digits(torch.tensor([[-2.0, -1.0, 0.0, 1.0]]))
        [[-1, 0, 128, 255]]
    """
    if proprio.device.type == "meta":  # an outline has no numbers, only as many of them
        return [[0] * proprio.shape[1]] * proprio.shape[0]
    edges = torch.linspace(-1, 1, BINS + 1, dtype=torch.float64)[:-1]
    bins = torch.bucketize(proprio.detach().double().cpu(), edges, right=True) - 1
    return [list(map(int, row)) for row in bins.tolist()]
