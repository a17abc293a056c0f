"""What every policy is that acts by tokens, each drawn after those before it."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torchrl.data.vla import ActionTokenizerBase

from worldenv_trl.policies.base import Policy

__all__ = ["TokenPolicy"]

_NARROW = -6.0  # the lowest log-scale of laplace_actor's own bounds


class TokenPolicy(Policy):
    """A policy whose action chunk is a sequence of tokens, one for each number, from the first action's first on.

    What acts and learns with it is :func:`~worldenv_trl.policies.autoregressive_actor`. A subclass implements
    :meth:`sample`, :meth:`logits`, :meth:`fit_statistics` and :meth:`post_training_parameters`. Called as any policy,
    it writes the greedy chunk as ``loc``, with a ``log_scale`` that means nothing.

    Attributes:
        action_tokenizer: codec of tokens and chunks, [n, C, 7] each; V is its ``vocab_size``.
        temperature: of its exploration, positive.
        rescored: whether one pass (:meth:`logits`) and the many of :meth:`sample` round so differently that tokens are
            scored again after they are drawn, so that LOOP begins with ratios of one.
    """

    action_tokenizer: ActionTokenizerBase
    temperature: float = 1.0
    rescored: bool = False

    @abc.abstractmethod
    def sample(
        self,
        images: Mapping[str, Tensor],
        state: Tensor,
        instructions: Sequence[str],
        temperature: float,
        greedy: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Tokens int64 [n, C, 7] and their log-probabilities float32 [n, C, 7], without a gradient.

        Args:
            images, state, instructions: see :meth:`Policy.predict`.
            temperature: what logits are divided by.
            greedy: the likeliest token each time.
        """

    @abc.abstractmethod
    def logits(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str], tokens: Tensor
    ) -> Tensor:
        """Of every token given those before it, in one pass: float32 [n, C, 7, V].

        Args:
            images, state, instructions: see :meth:`Policy.predict`.
            tokens: int64 [n, C, 7].
        """

    @torch.no_grad()
    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        tokens, _ = self.sample(images, state, instructions, 1.0, greedy=True)
        chunk = self.action_tokenizer.decode(tokens).float()
        return chunk, torch.full_like(chunk, _NARROW)

    def scale_parameters(self) -> list[nn.Parameter]:
        """None: tokens have no scale."""
        return []
