"""What policies share that act by tokens of a language model's own vocabulary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from worldenv_trl.policies.hf_backbone import autocast, full_precision
from worldenv_trl.policies.hf_token_backbone import TokenBackbone
from worldenv_trl.policies.token_policy import TokenPolicy
from worldenv_trl.policies.vision_language import VisionLanguagePolicy

if TYPE_CHECKING:
    from transformers import PreTrainedModel

    from worldenv_trl.policies.prismatic import PrismaticModel

__all__ = ["LanguageTokenPolicy"]


class LanguageTokenPolicy(TokenPolicy, VisionLanguagePolicy):
    """A vision-language model that goes on its prompt with some of its ids, which stand for actions.

    A token's probability is the softmax over these ids alone. What reads them out are the rows of the model's language
    head that belong to them, ``action_head``, which learns in full; the embeddings by which the model reads its own
    tokens again are the backbone's.

    A subclass calls :meth:`_make_readout` between ``_make_model`` and ``_prepare_learning``.
    """

    backbone: TokenBackbone
    action_ids: Tensor
    action_head: nn.Linear

    def _make_readout(
        self,
        model: PreTrainedModel | PrismaticModel,
        around: Mapping[str, object],
        ids: Sequence[int],
        opening: Sequence[int] = (),
    ) -> None:
        """Backbone and head.

        Args:
            model, around: what ``_make_model`` gives.
            ids: in the vocabulary, of token 0, 1 ...
            opening: see :class:`TokenBackbone`.
        """
        self.backbone = TokenBackbone(model, opening=opening, **around)  # type: ignore[arg-type]
        self._logit_cap: float | None = getattr(model.config.get_text_config(), "final_logit_softcapping", None)
        self.action_head = nn.Linear(self.backbone.dim, len(ids), bias=False)
        self.register_buffer("action_ids", torch.tensor(ids), persistent=False)

    def logits(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str], tokens: Tensor
    ) -> Tensor:
        ids, valid = self._prompt_tensors(instructions, state)
        with autocast(state.device, self._dtype):
            hidden = self.backbone(self._pixels(images), ids, valid, self.action_ids[tokens.flatten(1)])
        return self._logits(hidden).unflatten(1, tokens.shape[1:])

    def _logits(self, hidden: Tensor) -> Tensor:
        with full_precision(hidden.device):
            logits = self.action_head(hidden.float())
        if self._logit_cap is not None:
            logits = self._logit_cap * torch.tanh(logits / self._logit_cap)
        return logits

    def head_parameters(self) -> list[nn.Parameter]:
        """What reads action tokens out."""
        return list(self.action_head.parameters())

    @torch.no_grad()
    def take_output_embeddings(self, rows: Tensor) -> None:
        """Reads action tokens out as a pretrained language head does, [vocabulary, dim]."""
        if not rows.is_meta:  # an outline has no weights to give
            self.action_head.weight.copy_(rows[self.action_ids.to(rows.device)])

    def _check_free(
        self, begin: int, end: int, around: Mapping[str, object], remedy: str, more: Sequence[int] = ()
    ) -> None:
        """Raises ``ValueError`` if one of the ids that stand for actions is needed around images, by the prompt, or is
        one of ``more``."""
        texts = around["token_ids"]
        used = [*texts[0], *texts[1], *self.config.prompt_end, *more]  # type: ignore[index]
        used += [] if around["first_id"] is None else [around["first_id"]]
        taken = sorted({number for number in used if begin <= number < end})
        if taken:
            names = ", ".join(repr(self.tokenizer.id_to_token(number)) for number in taken)
            raise ValueError(
                f"the ids {begin} to {end - 1} stand for actions, and the prompt needs {names} among them: {remedy}"
            )
