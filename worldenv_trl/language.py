"""Goals as text: reading instructions from TensorDicts, words, and what a trained part has never been told."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from worldenv_trl.keys import INSTRUCTION

__all__ = ["PAD_WORD", "UNKNOWN_WORD", "SeenInstructions", "Vocabulary", "instructions_of", "split_words"]

PAD_WORD = "<pad>"
UNKNOWN_WORD = "<unk>"


def instructions_of(tensordict: TensorDictBase) -> list[str]:
    """``language_instruction`` of every row of a TensorDict [*B], flattened, whether the rows share one text or not.

    Raises:
        ValueError: if there is none.

    Examples:
        >>> from tensordict import NonTensorStack, TensorDict
        >>> texts = NonTensorStack("open the drawer", "turn on the stove")
        >>> instructions_of(TensorDict({"language_instruction": texts}, [2]))
        ['open the drawer', 'turn on the stove']
        >>> instructions_of(TensorDict({"language_instruction": "open the drawer"}, [2]))
        ['open the drawer', 'open the drawer']
    """
    text = tensordict.get(INSTRUCTION, None)
    if text is None:
        raise ValueError(f"the tensordict holds no {INSTRUCTION!r}: every part reads the goal as text")
    if isinstance(text, str):
        return [text] * tensordict.numel()
    nested = text.tolist()
    if isinstance(nested, str):  # no batch dimension
        return [nested]
    while nested and isinstance(nested[0], list):
        nested = [item for part in nested for item in part]
    return [str(words) for words in nested]


def split_words(text: str) -> list[str]:
    """Lower-case words; underscores and punctuation separate."""
    return "".join(c if c.isalnum() else " " for c in text.lower()).split()


class Vocabulary:
    """Words as numbers: 0 pads, 1 is any word that is not in it.

    Args:
        words: all words, :data:`PAD_WORD` and :data:`UNKNOWN_WORD` first; see :meth:`of`.
        max_words: of a longer instruction, the words behind are not read.

    Examples:
        >>> vocabulary = Vocabulary(Vocabulary.of(["open the drawer", "turn on the stove"]))
        >>> vocabulary.words
        ('<pad>', '<unk>', 'drawer', 'on', 'open', 'stove', 'the', 'turn')
        >>> vocabulary.ids(["Open the drawer!", "push the big drawer"])
        tensor([[4, 6, 2, 0],
                [1, 6, 1, 2]])
    """

    def __init__(self, words: Sequence[str], max_words: int = 16) -> None:
        self.words, self.max_words = tuple(words), int(max_words)
        self._ids = {word: index for index, word in enumerate(self.words)}
        self._cache: dict[str, list[int]] = {}

    @staticmethod
    def of(instructions: Sequence[str]) -> tuple[str, ...]:
        """The words of ``instructions``, sorted, after the two special ones."""
        return (PAD_WORD, UNKNOWN_WORD, *sorted({word for text in instructions for word in split_words(text)}))

    def ids(
        self, instructions: Sequence[str], device: torch.device | str | None = None, *, min_length: int = 1
    ) -> Tensor:
        """int64 [n, L], padded with 0 at the end.

        Args:
            instructions: n texts.
            device: of the result.

        Keyword Args:
            min_length: L is the length of the longest instruction, and no less than this: with the longest one of the
                training, a row does not depend on which others are in its batch.

        Raises:
            ValueError: for an instruction without words.
        """
        rows = [self._of_text(text) for text in instructions]
        length = max([min_length, *map(len, rows)])
        ids = [row + [0] * (length - len(row)) for row in rows]
        return torch.tensor(ids, dtype=torch.int64, device=device).reshape(len(rows), length)

    def _of_text(self, text: str) -> list[int]:
        if text not in self._cache:
            words = split_words(text)[: self.max_words]
            if not words:
                raise ValueError(f"an instruction must have a word, got {text!r}")
            self._cache[text] = [self._ids.get(word, self._ids[UNKNOWN_WORD]) for word in words]
        return self._cache[text]


class SeenInstructions:
    """What a trained part was told in training; warns, once for each, of instructions that it never saw.

    Args:
        part: what warns, in words: "the policy".
        instructions: of the training; empty for a part that was not trained, which never warns.

    Examples:
        >>> seen = SeenInstructions("the policy", ["open the drawer"])
        >>> with warnings.catch_warnings(action="always", record=True) as caught:
        ...     seen.check(["open the drawer", "close the drawer", "close the drawer"])
        >>> [str(warning.message)[:61] for warning in caught]
        ["the policy was never trained on the instruction 'close the dr"]
    """

    def __init__(self, part: str, instructions: Sequence[str]) -> None:
        self.part, self.instructions = part, tuple(instructions)
        self._known = set(self.instructions)

    def check(self, instructions: Sequence[str]) -> None:
        """Warns of the first sight of each instruction that is not among those of the training."""
        if not self.instructions:
            return
        for text in sorted(set(instructions) - self._known):
            self._known.add(text)
            warnings.warn(
                f"{self.part} was never trained on the instruction {text!r}; it was on "
                f"{', '.join(map(repr, self.instructions[:3]))}{' ...' if len(self.instructions) > 3 else ''}. "
                "It goes by the words that it knows: expect little",
                stacklevel=3,
            )
