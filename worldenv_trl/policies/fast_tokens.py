"""FAST (arXiv:2501.09747): an action chunk as the byte-pair tokens of its cosine transform."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor
from torchrl.data.vla import ActionTokenizerBase

from worldenv_trl.keys import ACTION_DIM
from worldenv_trl.policies.hf_files import local_folder, read_json, read_tokenizer

if TYPE_CHECKING:
    from tokenizers import Tokenizer

__all__ = ["FASTActionTokenizer"]

TOKENIZER_NAME, PROCESSOR_NAME = "tokenizer.json", "processor_config.json"
SCALE = 10.0
_CHARACTERS = 4096  # more than coefficients have values
_UNFITTED = 100  # of a coefficient's size, before the vocabulary is fitted
_TAUGHT = 10_000  # chunks that pairs are counted in: more take minutes and change little


class FASTActionTokenizer(ActionTokenizerBase):
    """Codec of whole chunks and of token sequences that end by themselves.

    Normalised actions ``(a - center) / gain`` [H, 7] are transformed over time (orthonormal DCT-II), multiplied by
    ``scale``, rounded, flattened with the lowest frequency of all dimensions first, written as characters
    ``chr(coefficient - min_token)`` and compressed by byte-pair encoding. Behind them stands the end token, and once
    more in every place that is left of ``max_tokens``.

    What was rounded comes back exactly: a coefficient is off by at most half of ``1 / scale``, and so is the root of
    the mean square of a dimension's error over time, in units of ``gain``. A coefficient of which the vocabulary has no
    character becomes the nearest that it has.

    Until :meth:`fit` trains a vocabulary, or a pretrained one is read, every coefficient is a token of its own.

    Args:
        horizon: H, actions of a chunk.

    Keyword Args:
        size: tokens that a vocabulary may have; the end token is one more.
        max_tokens: L, of a sequence; as many as there are coefficients, and the end, when 0.

    Attributes:
        center, gain: normalisation of each action dimension, float64 [7]; 0 and 1 until they are set.
        scale: of the coefficients before they are rounded.
        min_token: the coefficient whose character is number 0.
        bpe: the vocabulary, of the library ``tokenizers``.

    Raises:
        ValueError: for a size that cannot be.

    Examples:
        >>> codec = FASTActionTokenizer(8, size=300)
        >>> chunks = torch.linspace(-1, 1, 8)[:, None].expand(5, 8, 7) * torch.rand(5, 1, 7)
        >>> codec.fit(chunks)
        >>> tokens = codec.encode(chunks)
        >>> tokens.shape, codec.decode(tokens).shape
        (torch.Size([5, 57]), torch.Size([5, 8, 7]))
        >>> (codec.decode(tokens) - chunks).square().mean(-2).sqrt().max() <= 0.5 / codec.scale
        tensor(True)
    """

    center: Tensor
    gain: Tensor

    def __init__(self, horizon: int, *, size: int = 1024, max_tokens: int = 0) -> None:
        super().__init__()
        if horizon < 1 or size < 2 or max_tokens < 0:
            raise ValueError(
                f"horizon must be at least 1, size at least 2 and max_tokens not negative, got {horizon}, {size}, "
                f"{max_tokens}"
            )
        self.horizon, self.size = horizon, size
        self.max_tokens = max_tokens or horizon * ACTION_DIM + 1
        self.register_buffer("center", torch.zeros(ACTION_DIM, dtype=torch.float64))
        self.register_buffer("gain", torch.ones(ACTION_DIM, dtype=torch.float64))
        self._transform = _cosines(horizon)
        half = min(_UNFITTED, (size - 1) // 2)
        self.set_vocabulary(_bytepairs(chr(n) for n in range(2 * half + 1)), SCALE, -half)

    @property
    def vocab_size(self) -> int:
        """Tokens, and the end."""
        return self.size + 1

    @property
    def end(self) -> int:
        """The token behind a chunk's."""
        return self.size

    @property
    def known(self) -> int:
        """How many tokens the vocabulary has, at most ``size``: the first ones."""
        return self.bpe.get_vocab_size()

    def set_vocabulary(self, bpe: Tokenizer, scale: float, min_token: int) -> None:
        """Takes another vocabulary, and what its characters mean.

        Raises:
            ValueError: if it has more tokens than ``size``, or no character of a coefficient.
        """
        if bpe.get_vocab_size() > self.size:
            raise ValueError(f"the vocabulary has {bpe.get_vocab_size()} tokens, more than size={self.size}")
        if not (math.isfinite(scale) and scale > 0):
            raise ValueError(f"scale must be positive, got {scale}")
        bpe.no_padding()
        bpe.no_truncation()
        coefficients = [n + min_token for n in range(_CHARACTERS) if _decoded(bpe, _encoded(bpe, chr(n))) == chr(n)]
        if not coefficients:
            raise ValueError("the vocabulary has no token of any coefficient: this is no tokenizer of FAST")
        self.bpe, self.scale, self.min_token = bpe, float(scale), int(min_token)
        self._coefficients = np.array(coefficients)

    @torch.no_grad()
    def set_normalization(self, center: Tensor, gain: Tensor) -> None:
        """Takes what is subtracted from actions and what they are divided by, [7] each."""
        self.center.copy_(center)
        self.gain.copy_(gain)

    def fit(self, actions: Tensor, *, scale: float = SCALE) -> None:
        """Trains the vocabulary on chunks [..., H, 7], which are normalised as at present.

        It has a token for each coefficient between the smallest and the largest that occur, then the most frequent
        pairs, until there are ``size`` or none occurs twice. The same chunks give the same vocabulary.

        Raises:
            ValueError: for chunks of another shape, numbers that are not finite, or more coefficients than ``size``.
        """
        coefficients = self._rounded(actions, scale)
        low, high = int(coefficients.min()), int(coefficients.max())
        if high - low + 1 > min(self.size, _CHARACTERS):
            raise ValueError(
                f"these actions have coefficients from {low} to {high}, a token each, and the vocabulary may have "
                f"{self.size}: more tokens, or a smaller scale than {scale:g}"
            )
        chosen = coefficients[:: -(-len(coefficients) // _TAUGHT)]
        texts = ["".join(map(chr, row)) for row in (chosen - low).tolist()]
        self.set_vocabulary(_bytepairs(map(chr, range(high - low + 1)), texts, self.size), scale, low)

    def encode(self, actions: Tensor) -> Tensor:
        """Tokens int64 [..., L] of chunks [..., H, 7], on their device.

        Raises:
            ValueError: for chunks of another shape, numbers that are not finite, or more than ``max_tokens``.
        """
        coefficients = self._nearest(self._rounded(actions, self.scale)) - self.min_token
        tokens = torch.full((len(coefficients), self.max_tokens), self.end)
        for row, numbers in enumerate(coefficients.tolist()):
            ids = _encoded(self.bpe, "".join(map(chr, numbers)))
            if len(ids) >= self.max_tokens:
                raise ValueError(
                    f"a chunk takes {len(ids) + 1} tokens with the end, at most {self.max_tokens} are allowed: raise "
                    "max_tokens"
                )
            tokens[row, : len(ids)] = torch.tensor(ids)
        return tokens.reshape(*actions.shape[:-2], self.max_tokens).to(actions.device)

    def decode(self, tokens: Tensor) -> Tensor:
        """Chunks float32 [..., H, 7] of tokens int64 [..., any number of them], on their device.

        What is drawn may stand for none. Coefficients that are missing at the end, the high frequencies, are zeros,
        those that are too many are left out, and no token at all is the chunk that is ``center`` throughout: the
        remedies of openpi and LeRobot.

        Raises:
            ValueError: for a token outside the vocabulary, or tokens that are not whole numbers [..., n].
        """
        if tokens.ndim < 1 or tokens.is_floating_point():
            raise ValueError(f"tokens must be whole numbers [..., n], got {tokens.dtype} {list(tokens.shape)}")
        shape = (*tokens.shape[:-1], self.horizon, ACTION_DIM)
        if tokens.is_meta:  # an outline has no numbers, only as many of them
            return torch.zeros(shape, device="meta")
        rows = tokens.reshape(math.prod(shape[:-2]), tokens.shape[-1]).tolist()
        wrong = [token for row in rows for token in row if not 0 <= token <= self.end]
        if wrong:
            raise ValueError(f"tokens must lie between 0 and {self.end}, the end, got {wrong[0]}")
        wanted = self.horizon * ACTION_DIM
        coefficients = np.zeros((len(rows), wanted))
        for row, numbers in enumerate(rows):
            said = numbers[: numbers.index(self.end)] if self.end in numbers else numbers
            found = np.array([ord(each) for each in _decoded(self.bpe, said)][:wanted], dtype=int) + self.min_token
            # Half of a character, of vocabularies of bytes, is none.
            coefficients[row, : len(found)] = np.where(np.isin(found, self._coefficients), found, 0)
        frequencies = torch.from_numpy(coefficients).reshape(-1, self.horizon, ACTION_DIM) / self.scale
        actions = self._transform.mT @ frequencies
        return (actions.to(self.gain) * self.gain + self.center).float().reshape(shape).to(tokens.device)

    def is_pad(self, tokens: Tensor) -> Tensor:
        """Which tokens stand behind the end, bool like ``tokens`` [..., L]: they were never drawn, and mean nothing."""
        ended = tokens == self.end
        return (ended.cumsum(-1) - ended.long()) > 0

    def files(self) -> dict[str, bytes]:
        """What :meth:`save_pretrained` writes, by name."""
        described = {
            "scale": self.scale,
            "vocab_size": self.size,
            "min_token": self.min_token,
            "time_horizon": self.horizon,
            "action_dim": ACTION_DIM,
        }
        return {
            TOKENIZER_NAME: self.bpe.to_str().encode(),
            PROCESSOR_NAME: (json.dumps(described, indent=2) + "\n").encode(),
        }

    def save_pretrained(self, folder: str | os.PathLike) -> Path:
        """Writes the vocabulary as ``physical-intelligence/fast`` has it, ``tokenizer.json`` and
        ``processor_config.json``; normalisation is not part of it."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in self.files().items():
            (folder / name).write_bytes(data)
        return folder

    @classmethod
    def from_pretrained(cls, folder: str | os.PathLike, horizon: int, *, max_tokens: int = 0) -> Self:
        """The codec of a folder, or ``owner/name`` of the Hub, in this layout. None of its code is run.

        Args:
            folder: with ``tokenizer.json`` and ``processor_config.json``.
            horizon: actions of a chunk; where the folder tells one, it must be the same.

        Keyword Args:
            max_tokens: of a sequence, see the class.

        Raises:
            FileNotFoundError: if a file is missing.
            ValueError: if it was made for other chunks, or one of its files is not FAST's.
        """
        folder = local_folder(folder)
        described, path = read_json(folder, PROCESSOR_NAME), folder / PROCESSOR_NAME
        return cls.read(described, read_tokenizer(folder), horizon, path, max_tokens)

    @classmethod
    def read(cls, described: dict[str, Any], bpe: Tokenizer, horizon: int, path: Path, max_tokens: int = 0) -> Self:
        """Of the two files' contents, the first one's ``path`` being named in errors; see :meth:`from_pretrained`."""
        numbers = {name: described.get(name) for name in ("scale", "min_token")}
        missing = [name for name, value in numbers.items() if not isinstance(value, int | float) or value != value]
        if missing:
            raise ValueError(f"{path} has no number {' and '.join(missing)}: this is no tokenizer of FAST")
        for name, wanted in (("time_horizon", horizon), ("action_dim", ACTION_DIM)):
            if described.get(name) not in (None, wanted):
                raise ValueError(
                    f"{path}: {name} is {described[name]}, the policy's chunks have {wanted}: take a tokenizer for "
                    f"these, or train one (FASTActionTokenizer.fit)"
                )
        size = described.get("vocab_size") or 0
        if not isinstance(size, int):
            raise ValueError(f"{path}: vocab_size must be a whole number, got {size!r}")
        codec = cls(horizon, size=max(bpe.get_vocab_size(), size), max_tokens=max_tokens)
        try:
            codec.set_vocabulary(bpe, described["scale"], described["min_token"])
        except ValueError as error:
            raise ValueError(f"{path.parent}: {error}") from error
        return codec

    def _rounded(self, actions: Tensor, scale: float) -> np.ndarray:
        """Coefficients [N, H * 7] of chunks [..., H, 7], frequency after frequency, whole numbers."""
        if actions.ndim < 2 or tuple(actions.shape[-2:]) != (self.horizon, ACTION_DIM):
            raise ValueError(
                f"this tokenizer is for chunks [..., {self.horizon}, {ACTION_DIM}], got {list(actions.shape)}: "
                f"chunk_length={self.horizon}, or another tokenizer"
            )
        if not actions.numel() or not torch.isfinite(actions).all():
            raise ValueError("actions must hold at least one chunk and only finite numbers")
        normal = ((actions.to(self.gain) - self.center) / self.gain).cpu()
        return (self._transform @ normal * scale).round().long().reshape(-1, self.horizon * ACTION_DIM).numpy()

    def _nearest(self, coefficients: np.ndarray) -> np.ndarray:
        known = self._coefficients
        above = np.searchsorted(known, coefficients).clip(max=len(known) - 1)
        below = (above - 1).clip(min=0)
        nearer = np.abs(known[below] - coefficients) < np.abs(known[above] - coefficients)
        return known[np.where(nearer, below, above)]


def _cosines(length: int) -> Tensor:
    """The orthonormal DCT-II, float64 [frequencies, times]."""
    when = torch.arange(length, dtype=torch.float64, device="cpu")
    matrix = torch.cos(math.pi * (when + 0.5) * when[:, None] / length) * math.sqrt(2 / length)
    matrix[0] /= math.sqrt(2)
    return matrix


def _bytepairs(alphabet: Any, texts: list[str] | None = None, size: int = 0) -> Tokenizer:
    """A vocabulary of these characters, and of the pairs that texts are shortest with.

    Without the bytes of the released one, whose tokens can end within a character.
    """
    from tokenizers import Tokenizer, decoders, models, trainers

    characters = list(alphabet)
    bpe = Tokenizer(models.BPE(vocab={each: number for number, each in enumerate(characters)}, merges=[]))
    bpe.decoder = decoders.Fuse()
    if texts:
        trainer = trainers.BpeTrainer(
            vocab_size=size,
            min_frequency=2,
            initial_alphabet=characters,
            show_progress=False,
            max_token_length=None,
        )
        bpe.train_from_iterator(texts, trainer)
    return bpe


def _encoded(bpe: Tokenizer, text: str) -> list[int]:
    return list(bpe.encode(text, add_special_tokens=False).ids)


def _decoded(bpe: Tokenizer, ids: list[int]) -> str:
    return str(bpe.decode(ids, skip_special_tokens=False))
