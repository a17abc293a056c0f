"""pi0-FAST's recipe (arXiv:2501.09747): a vision-language model that says whole action chunks, compressed."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from worldenv_trl.policies.fast_tokens import SCALE, FASTActionTokenizer
from worldenv_trl.policies.flow_prompts import state_digits
from worldenv_trl.policies.hf_backbone import autocast
from worldenv_trl.policies.hf_files import read_json, tokenizer_of
from worldenv_trl.policies.language_tokens import LanguageTokenPolicy
from worldenv_trl.policies.vision_language import TOKENIZER_NAME, VisionLanguageConfig
from worldenv_trl.row_share import own_rows

if TYPE_CHECKING:
    from tokenizers import Tokenizer
    from transformers import PreTrainedModel

    from worldenv_trl.policies.prismatic import PrismaticModel

__all__ = ["FASTConfig", "FASTPolicy"]

VOCABULARY_NAME, CODEC_NAME = "action_tokenizer.json", "action_processor_config.json"


@dataclass(frozen=True)
class FASTConfig(VisionLanguageConfig):
    """What a :class:`FASTPolicy` is made of, and trained for.

    Args:
        backbone, instructions, cameras, image_size, chunk_length, proprio, resolution, rotation, mirror, crop_area,
            image_mean, image_std, prompt_end, proprio_format, fixed_statistics, lora_rank, lora_alpha, dtype,
            gradient_checkpointing: see :class:`~worldenv_trl.policies.vision_language.VisionLanguageConfig`.
        prompt: with ``{instruction}``, and with ``{state}`` where the policy is to know proprioception: its numbers
            are told as the bins 0 to 255 that they fall into, or -1 below them.
        padded_state: numbers of proprioception that the prompt tells, the missing ones as the middle bin; only those
            that there are when 0.
        opening: what is said before the first action token in every decision.
        end: the tokenizer's token that is said behind the last one.
        horizon: actions that the tokens of a decision stand for, of which the first ``chunk_length`` are executed;
            ``chunk_length`` when 0.
        max_tokens: of a decision, with the end; as many as actions have numbers, and the end, when 0.
        fast_vocab_size: action tokens, without the end.
        scale: of the coefficients before they are rounded, where the vocabulary is trained.
        fixed_tokenizer: keep the vocabulary of action tokens that the policy came with:
            :meth:`FASTPolicy.fit_statistics` else trains one. It keeps it with ``fixed_statistics``, too.
        action_token_end: id behind the region of the vocabulary that holds the action tokens, the first of them last;
            the size of the tokenizer's own vocabulary, without what was added to it, when 0.
        skip_tokens: ids at the end of that region that are left free.
        temperature: of its exploration.

    Raises:
        ValueError: for a size, a prompt, a temperature or a family that cannot be built.
    """

    prompt: str = "Task: {instruction}, State: {state};\n"
    crop_area: float = 1.0
    padded_state: int = 0
    opening: str = "Action: "
    end: str = "|"
    horizon: int = 0
    max_tokens: int = 0
    fast_vocab_size: int = 1024
    scale: float = SCALE
    fixed_tokenizer: bool = False
    action_token_end: int = 0
    skip_tokens: int = 128
    temperature: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.horizon:
            object.__setattr__(self, "horizon", self.chunk_length)
        if not 1 <= self.chunk_length <= self.horizon:
            raise ValueError(
                f"chunk_length must be at least 1 and at most {self.horizon}, the actions that a decision's tokens "
                f"stand for, got {self.chunk_length}"
            )
        if 0 < self.max_tokens <= self.chunk_length:
            raise ValueError(
                f"max_tokens must be more than chunk_length={self.chunk_length}, or 0, got {self.max_tokens}"
            )
        if self.fast_vocab_size < 2 or min(self.action_token_end, self.skip_tokens, self.padded_state) < 0:
            raise ValueError(
                "fast_vocab_size must be at least 2, action_token_end, skip_tokens and padded_state not negative, got "
                f"{self.fast_vocab_size}, {self.action_token_end}, {self.skip_tokens}, {self.padded_state}"
            )
        for name, value in (("scale", self.scale), ("temperature", self.temperature)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value}")


class FASTPolicy(LanguageTokenPolicy):
    """Maps images, proprioception and the instruction to the tokens of a whole action chunk, as many as it takes.

    After the prompt and ``opening``, the model says tokens of FAST and the ``end``; nothing else can be drawn. Tokens
    are [n, L], L being ``max_tokens``: those of FAST are 0 to ``fast_vocab_size - 1``, the end, which also pads, is the
    number behind. A sequence that is L tokens long ends there. Every token of a sequence belongs to every action of
    the chunk.

    :meth:`fit_statistics` trains FAST's vocabulary on the data, unless one is given that is to stay.

    Args:
        config: its settings.
        tokenizer: of the backbone; saved beside the weights as ``tokenizer.json``.
        model: see :class:`~worldenv_trl.policies.HFTokenPolicy`.
        action_tokenizer: for chunks of ``horizon`` actions and ``fast_vocab_size`` tokens; saved beside the weights.

    Raises:
        ValueError: if the tokenizer lacks a token that the family or the end needs, an action token has another
            meaning, or the action tokenizer is for other chunks.
    """

    config_class = FASTConfig
    companion_names: ClassVar[tuple[str, ...]] = (TOKENIZER_NAME, VOCABULARY_NAME, CODEC_NAME)
    sequential = True
    resize = "bilinear"
    config: FASTConfig
    action_tokenizer: FASTActionTokenizer

    def __init__(
        self,
        config: FASTConfig,
        tokenizer: Tokenizer,
        model: PreTrainedModel | PrismaticModel | None = None,
        action_tokenizer: FASTActionTokenizer | None = None,
    ) -> None:
        super().__init__(config, tokenizer)
        model, around = self._make_model(model)
        codec = action_tokenizer or FASTActionTokenizer(
            config.horizon, size=config.fast_vocab_size, max_tokens=config.max_tokens
        )
        if (codec.horizon, codec.size) != (config.horizon, config.fast_vocab_size):
            raise ValueError(
                f"the action tokenizer is for {codec.horizon} actions and has {codec.size} tokens, the policy's "
                f"horizon is {config.horizon} and its fast_vocab_size {config.fast_vocab_size}"
            )
        self.action_tokenizer = codec
        opening = tokenizer.encode(config.opening, add_special_tokens=False).ids
        ids = self._find_action_tokens(int(model.config.get_text_config().vocab_size), around, opening)
        self._make_readout(model, around, ids, opening)
        self.temperature, self.rescored = config.temperature, self._dtype != torch.float32
        self._prepare_learning()

    @classmethod
    def from_backbone(
        cls,
        folder: str | os.PathLike,
        *,
        action_tokenizer: str | os.PathLike | None = None,
        device: str | torch.device = "cpu",
        **settings: Any,
    ) -> Self:
        """A policy over a pretrained vision-language model that has not yet acted.

        Args:
            folder: see :meth:`~worldenv_trl.policies.vision_language.VisionLanguagePolicy.from_backbone`.

        Keyword Args:
            action_tokenizer: folder or Hub id of FAST's, such as ``physical-intelligence/fast``, which then stays; one
                is trained by :meth:`fit_statistics` when None.
            device, settings: as there.

        Raises:
            FileNotFoundError: if a file is missing.
            ValueError: see there, and :meth:`FASTActionTokenizer.from_pretrained`.
        """
        if action_tokenizer is None:
            return super().from_backbone(folder, device=device, **settings)
        length = settings.get("horizon") or settings.get("chunk_length", FASTConfig.chunk_length)
        codec = FASTActionTokenizer.from_pretrained(action_tokenizer, length)
        settings |= {"fast_vocab_size": codec.size, "scale": codec.scale, "fixed_tokenizer": True}
        policy = super().from_backbone(folder, device=device, **settings)
        policy.action_tokenizer.set_vocabulary(codec.bpe, codec.scale, codec.min_token)
        return policy

    @property
    def token_shape(self) -> tuple[int, ...]:
        return (self.action_tokenizer.max_tokens,)

    def token_is_pad(self, tokens: Tensor) -> Tensor:
        return self.action_tokenizer.is_pad(tokens)

    def sample(
        self,
        images: Mapping[str, Tensor],
        state: Tensor,
        instructions: Sequence[str],
        temperature: float,
        greedy: bool = False,
    ) -> tuple[Tensor, Tensor]:
        end, length, size = self.action_tokenizer.end, self.action_tokenizer.max_tokens, len(self.action_ids)
        rows, said, scores = state.shape[0], list[Tensor](), list[Tensor]()
        ended = torch.zeros(rows, dtype=torch.bool, device=state.device)
        if not greedy:
            # For a whole sequence, however soon it ends: processes that share rows go on with the same random numbers.
            draws = own_rows(lambda count: state.new_empty(count, length, size).exponential_(), rows)
            draws = draws.clamp_min_(torch.finfo(draws.dtype).tiny).log_()

        def choose(hidden: Tensor) -> Tensor:
            nonlocal ended
            scaled = self._logits(hidden) / temperature
            token = (scaled if greedy else scaled - draws[:, len(said)]).argmax(-1)  # see HFTokenPolicy.sample
            token = token.masked_fill(ended, end)
            score = scaled.log_softmax(-1).gather(-1, token[:, None])[:, 0]
            said.append(token)
            scores.append(score.masked_fill(ended, 0.0))
            ended = ended | (token == end)
            return self.action_ids[token]

        ids, valid = self._prompt_tensors(instructions, state)
        with torch.no_grad(), autocast(state.device, self._dtype):
            self.backbone.generate(
                self._pixels(images), ids, valid, length, choose, lambda: not ended.is_meta and bool(ended.all())
            )
        left = (0, length - len(said))
        return pad(torch.stack(said, 1), left, value=end), pad(torch.stack(scores, 1), left)

    @torch.no_grad()
    def fit_statistics(self, states: Tensor, actions: Tensor) -> None:
        """Takes the bounds of proprioception and actions from data, as other policies do, and trains FAST's vocabulary
        on the actions, whole chunks [..., horizon, 7].

        Nothing changes where the config has ``fixed_statistics``, and the vocabulary stays with ``fixed_tokenizer``.

        Raises:
            ValueError: for no data, numbers that are not finite, or chunks of another length.
        """
        super().fit_statistics(states, actions)
        if not (self.config.fixed_statistics or self.config.fixed_tokenizer):
            self.action_tokenizer.fit(actions, scale=self.config.scale)

    def companions(self) -> dict[str, bytes]:
        files = self.action_tokenizer.files()
        return super().companions() | dict(zip((VOCABULARY_NAME, CODEC_NAME), files.values(), strict=True))

    @classmethod
    def build(cls, config: FASTConfig, folder: Path) -> Self:
        from transformers.initialization import no_init_weights

        described, bpe = read_json(folder, CODEC_NAME), tokenizer_of(folder / VOCABULARY_NAME)
        codec = FASTActionTokenizer.read(described, bpe, config.horizon, folder / CODEC_NAME, config.max_tokens)
        tokenizer = tokenizer_of(folder / TOKENIZER_NAME)
        with no_init_weights():  # billions of random numbers take minutes
            return cls(config, tokenizer, action_tokenizer=codec)

    def _logits(self, hidden: Tensor) -> Tensor:
        logits, known = super()._logits(hidden), self.action_tokenizer.known
        if known < self.action_tokenizer.size:  # what stands for nothing cannot be said
            unknown = torch.zeros(logits.shape[-1], dtype=torch.bool, device=logits.device)
            unknown[known:-1] = True
            logits = logits.masked_fill(unknown, -torch.inf)
        return logits

    def _set_action_bounds(self, center: Tensor, half: Tensor) -> None:
        self.action_tokenizer.set_normalization(center, half)

    def _worded(self, instruction: str) -> str:
        return instruction.strip().replace("_", " ").replace("\n", " ")

    def _state_bins(self, state: Tensor) -> list[list[int]]:
        center, half = (self.state_low + self.state_high) / 2, (self.state_high - self.state_low) / 2
        told = (self._proprio(state) - center) / half
        return state_digits(pad(told, (0, max(0, self.config.padded_state - told.shape[-1]))))

    def _find_action_tokens(self, vocabulary: int, around: Mapping[str, object], opening: Sequence[int]) -> list[int]:
        """Ids of the action tokens, in the order of theirs, and of the end."""
        config, tokenizer = self.config, self.tokenizer
        last = tokenizer.token_to_id(config.end)
        if last is None:
            raise ValueError(
                f"the tokenizer has no token {config.end!r}, which ends an action chunk: take the tokenizer of this "
                "backbone, or name another end"
            )
        top = (config.action_token_end or tokenizer.get_vocab_size(with_added_tokens=False)) - config.skip_tokens
        begin = top - config.fast_vocab_size
        if begin < 0 or top > vocabulary:
            raise ValueError(
                f"the {config.fast_vocab_size} action tokens would have the ids {begin} to {top - 1}, the backbone "
                f"knows 0 to {vocabulary - 1}: a smaller fast_vocab_size or skip_tokens, or another action_token_end"
            )
        self._check_free(begin, top, around, "name another action_token_end", [last, *opening])
        return [*range(top - 1, begin - 1, -1), last]
