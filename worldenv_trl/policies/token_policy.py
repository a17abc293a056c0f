"""What every policy is that acts by tokens, each drawn after those before it."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torchrl.data.vla import ActionTokenizerBase

from worldenv_trl.keys import ACTION_DIM
from worldenv_trl.policies.base import Policy

__all__ = ["TokenPolicy"]

_NARROW = -6.0  # the lowest log-scale of laplace_actor's own bounds


class TokenPolicy(Policy):
    """A policy whose action chunk is a sequence of tokens, each drawn after those before it.

    Mostly there is one for each number, from the first action's first on, and the tokens of a chunk have the shape
    (C, 7). The tokens of a policy that is ``sequential`` belong to the whole chunk, (L,): a sequence that ends by
    itself, padded.

    What acts and learns with it is :class:`~worldenv_trl.policies.AutoregressiveActor`. A subclass implements
    :meth:`sample`, :meth:`logits`, :meth:`fit_statistics` and :meth:`post_training_parameters`, one that is
    ``sequential`` :attr:`token_shape` and :meth:`token_is_pad`, too. Called as any policy, it writes the greedy chunk
    as ``loc``, with a ``log_scale`` that means nothing.

    Attributes:
        action_tokenizer: codec of tokens [n, *token_shape] and chunks [n, C, 7], or of more actions, of which the
            first C are taken; V is its ``vocab_size``.
        temperature: of its exploration, positive.
        rescored: whether one pass (:meth:`logits`) and the many of :meth:`sample` round so differently that tokens are
            scored again after they are drawn, so that LOOP begins with ratios of one.
    """

    action_tokenizer: ActionTokenizerBase
    temperature: float = 1.0
    rescored: bool = False
    sequential: bool = False

    @property
    def token_shape(self) -> tuple[int, ...]:
        """Of a chunk's tokens: (C, 7), or (L,)."""
        return (self.chunk_length, ACTION_DIM)

    def token_is_pad(self, tokens: Tensor) -> Tensor:
        """Which tokens stand behind the end of their sequence, bool like ``tokens`` [..., *token_shape]."""
        return torch.zeros_like(tokens, dtype=torch.bool)

    def decode(self, tokens: Tensor) -> Tensor:
        """The chunks, float32 [..., C, 7], of tokens [..., *token_shape]."""
        return self.action_tokenizer.decode(tokens)[..., : self.chunk_length, :].float()

    @abc.abstractmethod
    def sample(
        self,
        images: Mapping[str, Tensor],
        state: Tensor,
        instructions: Sequence[str],
        temperature: float,
        greedy: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Tokens int64 [n, *token_shape] and their log-probabilities float32, 0 of padding, without a gradient.

        Args:
            images, state, instructions: see :meth:`Policy.predict`.
            temperature: what logits are divided by.
            greedy: the likeliest token each time.
        """

    @abc.abstractmethod
    def logits(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str], tokens: Tensor
    ) -> Tensor:
        """Of every token given those before it, in one pass: float32 [n, *token_shape, V].

        Args:
            images, state, instructions: see :meth:`Policy.predict`.
            tokens: int64 [n, *token_shape].
        """

    @torch.no_grad()
    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        tokens, _ = self.sample(images, state, instructions, 1.0, greedy=True)
        chunk = self.decode(tokens)
        return chunk, torch.full_like(chunk, _NARROW)

    def scale_parameters(self) -> list[nn.Parameter]:
        """None: tokens have no scale."""
        return []
