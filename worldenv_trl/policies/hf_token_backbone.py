"""A Hugging Face vision-language model that goes on a prompt token by token."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from worldenv_trl.policies.hf_backbone import VisionLanguageBackbone

if TYPE_CHECKING:
    from transformers import PreTrainedModel

    from worldenv_trl.policies.prismatic import PrismaticModel

__all__ = ["TokenBackbone"]


class TokenBackbone(VisionLanguageBackbone):
    """Hidden states that tell the next token, of images, a prompt and the tokens so far.

    The sequence is the text's first special token, each camera's image between its family's tokens, the text and the
    tokens. Images and text are seen as in pretraining; a token sees these and the tokens before it.

    Args:
        model, token_ids, first_id: see :class:`~worldenv_trl.policies.hf_backbone.VisionLanguageBackbone`.
        opening: ids of tokens that are said before the first one in every row. Unlike the prompt's, they see only what
            is before them, and no prompt sees them.
    """

    def __init__(
        self,
        model: PreTrainedModel | PrismaticModel,
        *,
        token_ids: tuple[Sequence[int], Sequence[int]] = ((), ()),
        first_id: int | None = None,
        opening: Sequence[int] = (),
    ) -> None:
        super().__init__(model, token_ids=token_ids, first_id=first_id)
        self.opening = tuple(opening)

    def forward(self, pixels: Tensor, ids: Tensor, valid: Tensor, tokens: Tensor) -> Tensor:  # type: ignore[override]
        """What each token is predicted from, [n, T, dim], in one pass.

        Args:
            pixels: prepared images of every camera, [n, cameras, 3, H, W].
            ids: of the text behind its first special token, int64 [n, L], padded in front.
            valid: which of them are no padding, bool [n, L].
            tokens: that come behind it, by their ids in the vocabulary, int64 [n, T].
        """
        count = tokens.shape[1]
        prompt, allowed, positions = self._prompted(pixels, ids, valid, count - 1)
        embed = self.language_model.get_input_embeddings()
        sequence = torch.cat([prompt, embed(tokens[:, :-1]).to(prompt.dtype)], 1)
        hidden = self.language_model(
            inputs_embeds=sequence,
            attention_mask=self._additive(allowed, prompt.dtype),
            position_ids=positions,
            use_cache=False,
        ).last_hidden_state
        return hidden[:, -count:]

    @torch.no_grad()
    def generate(
        self,
        pixels: Tensor,
        ids: Tensor,
        valid: Tensor,
        count: int,
        choose: Callable[[Tensor], Tensor],
        ended: Callable[[], bool] | None = None,
    ) -> Tensor:
        """Tokens int64 [n, count], one after the other; keys and values of what came before are kept.

        Args:
            pixels, ids, valid: see :meth:`forward`.
            count: of the tokens.
            choose: from hidden states [n, dim] to the ids of the next tokens, int64 [n].
            ended: asked after each token whether the rest is not wanted: [n, fewer] then.
        """
        from transformers import DynamicCache

        part, allowed, positions = self._prompted(pixels, ids, valid, count - 1)
        dtype, embed = part.dtype, self.language_model.get_input_embeddings()
        kept, tokens, begin = DynamicCache(), list[Tensor](), 0
        with _evaluating(self.language_model):
            for _ in range(count):
                end = begin + part.shape[1]
                hidden = self.language_model(
                    inputs_embeds=part,
                    attention_mask=self._additive(allowed[:, begin:end, :end], dtype),
                    position_ids=positions[..., begin:end],
                    past_key_values=kept,
                    use_cache=True,
                ).last_hidden_state
                tokens.append(choose(hidden[:, -1]))
                if ended is not None and ended():
                    break
                part, begin = embed(tokens[-1][:, None]).to(dtype), end
        return torch.stack(tokens, 1)

    def _prompted(self, pixels: Tensor, ids: Tensor, valid: Tensor, behind: int) -> tuple[Tensor, Tensor, Tensor]:
        """The sequence [n, S, dim] ahead of the first token; mask and positions with room for ``behind`` tokens."""
        front, sides = self._front(pixels, ids.device)
        dtype = front[sides[0]].dtype
        parts = [*front, self.language_model.get_input_embeddings()(ids)]
        if self.opening:
            parts.append(self._tokens(self.opening, ids.shape[0], ids.device))
        behind += len(self.opening)
        seen = self._seen(valid, front, behind)
        return torch.cat(parts, 1).to(dtype), self._allowed(seen, behind), self._positions(seen, front, sides)

    def _allowed(self, seen: Tensor, behind: int) -> Tensor:
        """Bool [n, S, S]: every token sees those before it, and a prefix that sees itself all of the prefix."""
        index = torch.arange(seen.shape[1], device=seen.device)
        within = index[None, :] <= index[:, None]
        if self.family.prefix_sees_itself:
            prefix = index < seen.shape[1] - behind
            within = within | (prefix[None, :] & prefix[:, None])
        eye = torch.eye(seen.shape[1], dtype=torch.bool, device=seen.device)  # see VisionLanguageBackbone
        return (seen[:, None, :] & within) | eye


@contextmanager
def _evaluating(module: nn.Module) -> Iterator[None]:
    """transformers' layers keep no keys and values while they are checkpointed, which they are in training alone."""
    training: list[Any] = [each for each in module.modules() if each.training]
    try:
        for each in training:
            each.training = False
        yield
    finally:
        for each in training:
            each.training = True
