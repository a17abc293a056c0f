"""OpenVLA's recipe (arXiv:2406.09246), actions as the vocabulary's last tokens, over a Hugging Face model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from worldenv_trl.keys import ACTION_DIM
from worldenv_trl.policies.action_tokens import QuantileActionTokenizer
from worldenv_trl.policies.hf_backbone import autocast
from worldenv_trl.policies.language_tokens import LanguageTokenPolicy
from worldenv_trl.policies.vision_language import VisionLanguageConfig
from worldenv_trl.row_share import own_rows

if TYPE_CHECKING:
    from tokenizers import Tokenizer
    from transformers import PreTrainedModel

    from worldenv_trl.policies.prismatic import PrismaticModel

__all__ = ["HFTokenConfig", "HFTokenPolicy"]


@dataclass(frozen=True)
class HFTokenConfig(VisionLanguageConfig):
    """What an :class:`HFTokenPolicy` is made of, and trained for.

    Args:
        backbone, instructions, cameras, image_size, chunk_length, proprio, resolution, rotation, mirror, crop_area,
            image_mean, image_std, prompt_end, proprio_format, fixed_statistics, lora_rank, lora_alpha, dtype,
            gradient_checkpointing: see :class:`~worldenv_trl.policies.vision_language.VisionLanguageConfig`.
        prompt: with ``{instruction}``, and with ``{state}`` where the policy is to know proprioception: its numbers, as
            the bins 0 to 255 that they fall into, stand there in words (pi0-FAST, pi0.5). OpenVLA knows none.
        num_bins: tokens that an action's number can be.
        action_token_end: id behind the last action token; the size of the tokenizer's own vocabulary, without what was
            added to it, when 0. OpenVLA: 32000.
        temperature: of its exploration. SimpleVLA-RL samples at 1.6.

    Raises:
        ValueError: for a size, a prompt, a temperature or a family that cannot be built.
    """

    num_bins: int = 256
    action_token_end: int = 0
    temperature: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_bins < 2 or self.action_token_end < 0:
            raise ValueError(
                "num_bins must be at least 2 and action_token_end not negative, got "
                f"{self.num_bins}, {self.action_token_end}"
            )
        if not (math.isfinite(self.temperature) and self.temperature > 0):
            raise ValueError(f"temperature must be positive, got {self.temperature}")


class HFTokenPolicy(LanguageTokenPolicy):
    """Maps images and a prompt to the tokens of an action chunk, one after the other.

    A vision-language model goes on its prompt with 7 tokens for each action. Only the ``num_bins`` ids before
    ``action_token_end`` can be drawn; see :class:`~worldenv_trl.policies.language_tokens.LanguageTokenPolicy`.
    Families: :data:`~worldenv_trl.policies.hf_backbone.FAMILIES`.

    Args:
        config: its settings.
        tokenizer: of the backbone; saved beside the weights as ``tokenizer.json``.
        model: the backbone without its language-modelling head, as ``AutoModelForImageTextToText...model``; with
            random weights when None. :meth:`from_backbone` reads a folder of pretrained ones,
            :func:`~worldenv_trl.policies.load_openvla` a checkpoint of OpenVLA.

    Raises:
        ValueError: if the tokenizer lacks a token that the family or an action needs, or an action token has another
            meaning.
    """

    config_class = HFTokenConfig
    config: HFTokenConfig
    action_tokenizer: QuantileActionTokenizer

    def __init__(
        self, config: HFTokenConfig, tokenizer: Tokenizer, model: PreTrainedModel | PrismaticModel | None = None
    ) -> None:
        super().__init__(config, tokenizer)
        model, tokens = self._make_model(model)
        text = model.config.get_text_config()
        self.first_action_id = self._find_action_tokens(int(text.vocab_size), tokens)
        self._make_readout(model, tokens, range(self.first_action_id, self.first_action_id + config.num_bins))
        self.action_tokenizer = QuantileActionTokenizer(config.num_bins)
        self.temperature, self.rescored = config.temperature, self._dtype != torch.float32
        self._prepare_learning()

    def sample(
        self,
        images: Mapping[str, Tensor],
        state: Tensor,
        instructions: Sequence[str],
        temperature: float,
        greedy: bool = False,
    ) -> tuple[Tensor, Tensor]:
        scores: list[Tensor] = []

        def choose(hidden: Tensor) -> Tensor:
            scaled = self._logits(hidden) / temperature
            chosen = scaled
            if not greedy:  # an exponential race: the first to arrive is drawn with the softmax's probabilities
                waits = own_rows(lambda count: scaled.new_empty(count, scaled.shape[1]).exponential_(), len(scaled))
                chosen = scaled - waits.clamp_min(torch.finfo(waits.dtype).tiny).log()
            token = chosen.argmax(-1)
            scores.append(scaled.log_softmax(-1).gather(-1, token[:, None])[:, 0])
            return token + self.first_action_id

        count = self.chunk_length * ACTION_DIM
        ids, valid = self._prompt_tensors(instructions, state)
        with torch.no_grad(), autocast(state.device, self._dtype):
            tokens = self.backbone.generate(self._pixels(images), ids, valid, count, choose)
        shape = (self.chunk_length, ACTION_DIM)
        return (tokens - self.first_action_id).unflatten(1, shape), torch.stack(scores, 1).unflatten(1, shape)

    def _set_action_bounds(self, center: Tensor, half: Tensor) -> None:
        self.action_tokenizer.set_bounds(center - half, center + half)

    def _find_action_tokens(self, vocabulary: int, tokens: Mapping[str, object]) -> int:
        """The id of the first action token."""
        config, tokenizer = self.config, self.tokenizer
        end = config.action_token_end or tokenizer.get_vocab_size(with_added_tokens=False)
        begin = end - config.num_bins
        if begin < 0 or end > vocabulary:
            raise ValueError(
                f"the {config.num_bins} action tokens would have the ids {begin} to {end - 1}, the backbone knows 0 "
                f"to {vocabulary - 1}: name fewer num_bins, or another action_token_end"
            )
        missing = [number for number in range(begin, end) if tokenizer.id_to_token(number) is None]
        if missing:
            raise ValueError(
                f"the tokenizer has no token of the ids {_ranges(missing)}, and {begin} to {end - 1} stand for "
                "actions: take the tokenizer of this backbone, or name another action_token_end"
            )
        self._check_free(begin, end, tokens, "name another action_token_end")
        return begin


def _ranges(numbers: Sequence[int]) -> str:
    """``3 to 5, 8`` of 3, 4, 5, 8."""
    ends = [n for n, after in zip(numbers, [*numbers[1:], None], strict=True) if after != n + 1]
    begins = [n for n, before in zip(numbers, [None, *numbers[:-1]], strict=True) if before is None or before != n - 1]
    return ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in zip(begins, ends, strict=True))
