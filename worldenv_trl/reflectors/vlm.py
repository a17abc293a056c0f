"""Reflectors on a frozen video language model: a trained reward head, or the model's own Yes against No."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from worldenv_trl import hub
from worldenv_trl.keys import INSTRUCTION
from worldenv_trl.language import instructions_of
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.reflectors.base import Lesson, Reflector
from worldenv_trl.reflectors.prefixes import prefix_indices
from worldenv_trl.reflectors.video_language_model import VideoLanguageModel
from worldenv_trl.reflectors.vlm_lessons import VLMLessons, lessons_of
from worldenv_trl.row_texts import row_texts

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes

__all__ = ["PromptReflector", "PromptReflectorConfig", "VLMReflector", "VLMReflectorConfig"]

_DEFAULT_LESSONS = VLMLessons()


@dataclass(frozen=True)
class _Config:
    """What both reflectors ask the model.

    Args:
        model: folder of a LLaVA-OneVision checkpoint in the layout of transformers, or ``owner/name`` on the Hub. It is
            named, not copied: only the head is saved.
        instructions: those of the training; others are answered with a warning. Empty: it never warns.
        camera: whose frames it looks at.
        num_frames: most frames of a prefix that are looked at, spread evenly.
        prompt: the question; ``{instruction}`` stands for the goal.
        template: of the chat, with ``{prompt}`` and, once, the video's token.
        score_every: frames 0, k, 2k ... are judged, the others keep the score before; a language pass each.
        prompts_per_call: prefixes in one language pass.
        dtype: of the model's weights: ``auto`` as they were saved, ``float32``, ``bfloat16``, ``float16``.

    Raises:
        ValueError: for numbers out of range, a prompt or a template without its places.
    """

    model: str
    instructions: tuple[str, ...] = ()
    camera: str = "agentview"
    num_frames: int = 32
    prompt: str = "Does the robot in the video complete the task: {instruction}? Answer only Yes or No."
    template: str = "<|im_start|>user <video>\n{prompt}<|im_end|><|im_start|>assistant\n"
    score_every: int = 1
    prompts_per_call: int = 8
    dtype: str = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(self, "instructions", tuple(self.instructions))
        if not hub.is_repo_id(self.model):  # found again from another working directory
            object.__setattr__(self, "model", str(Path(self.model).resolve()))
        if self.num_frames < 2:
            raise ValueError(f"num_frames must be at least 2, the first and the last frame, got {self.num_frames}")
        if min(self.score_every, self.prompts_per_call) < 1:
            raise ValueError(
                "score_every and prompts_per_call must be at least 1, "
                f"got {self.score_every} and {self.prompts_per_call}"
            )
        for name, place in (("prompt", "{instruction}"), ("template", "{prompt}")):
            if place not in getattr(self, name):
                raise ValueError(f"{name} must hold {place}, got {getattr(self, name)!r}")
        if self.dtype not in ("auto", "float32", "bfloat16", "float16"):
            raise ValueError(f"dtype must be auto, float32, bfloat16 or float16, got {self.dtype!r}")

    def text(self, instruction: str) -> str:
        """The whole prompt."""
        return self.template.replace("{prompt}", self.prompt.replace("{instruction}", instruction))


@dataclass(frozen=True)
class VLMReflectorConfig(_Config):
    """Of a :class:`VLMReflector`: its model and question as above, and its head.

    Args:
        pooling: ``last``, the state at the prompt's last token, which has seen everything, or ``mean``, over all.
        hidden_dim: of the reward head.
    """

    pooling: str = "last"
    hidden_dim: int = 512

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pooling not in ("last", "mean"):
            raise ValueError(f"pooling must be last or mean, got {self.pooling!r}")
        if self.hidden_dim < 1:
            raise ValueError(f"hidden_dim must be at least 1, got {self.hidden_dim}")


@dataclass(frozen=True)
class PromptReflectorConfig(_Config):
    """Of a :class:`PromptReflector`: its model and question as above, and the words it is asked to choose from."""

    yes: str = "Yes"
    no: str = "No"


class _VideoReflector(Reflector, Pretrained):
    """Keeps each frame's tokens, so that a longer prefix of a video costs one language pass."""

    config: _Config

    def __init__(self, config: _Config, vlm: VideoLanguageModel | None = None) -> None:
        super().__init__(cameras=(config.camera,), instructions=config.instructions)
        self.config = config
        self.vlm = VideoLanguageModel.load(config.model, config.dtype) if vlm is None else vlm
        self.vlm.prompt_ids(config.text("open the drawer"))  # a prompt without its video is refused here
        # The frozen model stays where it is: what is saved and continued are the few parameters that learn.
        self.register_state_dict_post_hook(_without_frozen)
        self.register_load_state_dict_post_hook(_frozen_is_not_missing)

    @abc.abstractmethod
    def judge(self, states: Sequence[Tensor]) -> Tensor:
        """R [P] of the last layer's states [S_i, D] of P prompts."""

    @torch.no_grad()
    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        self.seen.check(instructions)
        tokens = self.encode(frames).unsqueeze(1)  # [n, 1, T, D]
        count = len(tokens)
        state = TensorDict(
            {"tokens": tokens, "seen": torch.ones(count, dtype=torch.int64, device=tokens.device)}, batch_size=[count]
        )
        state.set(INSTRUCTION, row_texts(instructions))
        rows = torch.arange(count, device=tokens.device)
        return state.set("score", self.prefix_scores(tokens, rows, state["seen"], instructions))

    @torch.no_grad()
    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        video = frames[self._camera_in(frames)]
        count, length = video.shape[:2]
        new = self.encode({self.config.camera: video.flatten(0, 1)}).unflatten(0, (count, length))
        seen, known, texts = state["seen"], state["tokens"], instructions_of(state)
        tokens = new.new_zeros(count, max(known.shape[1], int(seen.max()) + length), *new.shape[2:])
        tokens[:, : known.shape[1]] = known
        number = seen.unsqueeze(-1) + torch.arange(length, device=seen.device)  # of the new frames, [n, C]
        tokens[torch.arange(count, device=seen.device).unsqueeze(-1), number] = new
        rows, place = (number % self.config.score_every == 0).nonzero(as_tuple=True)
        scores = state["score"].unsqueeze(-1).repeat(1, length + 1)
        judged = self.prefix_scores(tokens, rows, number[rows, place] + 1, [texts[row] for row in rows.tolist()])
        latest = torch.zeros_like(number).index_put_((rows, place), place + 1).cummax(1).values  # 0: the score before
        scores[rows, place + 1] = judged
        scores = scores.gather(1, latest)
        grown = TensorDict(
            {"tokens": tokens, "seen": seen + length, "score": scores[:, -1].clone()}, batch_size=[count]
        )
        return grown.set(INSTRUCTION, row_texts(texts)), scores

    def encode(self, frames: Mapping[str, Tensor]) -> Tensor:
        """Tokens [n, T, D] of frames uint8 [n, 3, H, W] of the camera.

        Raises:
            ValueError: for a camera that is missing.
        """
        return self.vlm.encode(frames[self._camera_in(frames)])

    def prefix_scores(self, tokens: Tensor, rows: Tensor, lengths: Tensor, instructions: Sequence[str]) -> Tensor:
        """R [P] of prefixes; see :meth:`prefix_states`."""
        parts = [self.judge(states).float() for states in self.prefix_states(tokens, rows, lengths, instructions)]
        return torch.cat(parts) if parts else tokens.new_zeros(0, dtype=torch.float32)

    def prefix_states(
        self, tokens: Tensor, rows: Tensor, lengths: Tensor, instructions: Sequence[str]
    ) -> Iterator[list[Tensor]]:
        """The model's last states of P prefixes, ``prompts_per_call`` at a time.

        Args:
            tokens: [R, N, T, D] of the frames of whole videos.
            rows: int64 [P], the video of each prefix.
            lengths: int64 [P], its number of frames.
            instructions: P texts.
        """
        prompts = [self.vlm.prompt_ids(self.config.text(text)) for text in instructions]
        for part in torch.arange(len(rows)).split(self.config.prompts_per_call) if len(rows) else ():
            index = prefix_indices(lengths[part.to(lengths.device)], self.config.num_frames)
            used = lengths[part.to(lengths.device)].clamp(max=index.shape[1]).tolist()
            videos = [
                tokens[row, index[place, :count]]
                for place, (row, count) in enumerate(zip(rows[part.to(rows.device)].tolist(), used, strict=True))
            ]
            yield self.vlm.hidden(videos, prompts[int(part[0]) : int(part[-1]) + 1])

    def _camera_in(self, frames: Mapping[str, Tensor]) -> str:
        if self.config.camera not in frames:
            raise ValueError(f"the reflector looks at {self.config.camera!r}, the frames are of {', '.join(frames)}")
        return self.config.camera


class VLMReflector(_VideoReflector):
    """World-Env's reflector: frozen LLaVA, its pooled state, a reward head and a sigmoid (section 3.3).

    Args:
        config: model, question and head.
        lessons: how the head learns in :meth:`train_on`; not saved.
        vlm: a model that is loaded already; the config's when None.

    Raises:
        FileNotFoundError: if the model's folder is not there.
        ValueError: for a model of another class, or a tokenizer without the video's token.
    """

    config_class: ClassVar[type] = VLMReflectorConfig
    config: VLMReflectorConfig

    def __init__(
        self,
        config: VLMReflectorConfig,
        lessons: VLMLessons = _DEFAULT_LESSONS,
        vlm: VideoLanguageModel | None = None,
    ) -> None:
        super().__init__(config, vlm)
        self.lessons = lessons
        width = self.vlm.width
        self.head = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, config.hidden_dim), nn.GELU(), nn.Linear(config.hidden_dim, 1)
        )
        self.log_scale, self.shift = (nn.Parameter(torch.zeros(())) for _ in range(2))

    def judge(self, states: Sequence[Tensor]) -> Tensor:
        return self.logits(self.pool(states)).sigmoid()

    def pool(self, states: Sequence[Tensor]) -> Tensor:
        """Embeddings float32 [P, D] of the last layer's states [S_i, D]."""
        return torch.stack(
            [row[-1].float() if self.config.pooling == "last" else row.float().mean(0) for row in states]
        )

    def logits(self, embeddings: Tensor) -> Tensor:
        """Calibrated log-odds [P] of embeddings [P, D] (Platt scaling of the head's)."""
        return self.head(embeddings).squeeze(-1) * self.log_scale.exp() + self.shift

    def train_on(self, episodes: Episodes) -> Iterator[Lesson]:
        """``head`` on embeddings of prefixes, made once; then ``calibration`` on episodes that the head has not seen.

        Raises:
            ValueError: at once, for episodes without labels or of other cameras.
        """
        return lessons_of(self, episodes)

    def training_loss(self, batch: TensorDictBase) -> TensorDict:
        """Binary cross-entropy of ``embedding`` [P, D] against ``label`` bool [P, 1]."""
        logits, label = self.logits(batch["embedding"]), batch["label"].squeeze(-1)
        accuracy = ((logits.detach() > 0) == label).float().mean()
        return TensorDict(
            {"loss_reflector": F.binary_cross_entropy_with_logits(logits, label.float()), "accuracy": accuracy}
        )


class PromptReflector(_VideoReflector):
    """The probability that the model's next word is Yes, given that it is Yes or No. It is not trained.

    Args:
        config: model, question and the two words.
        vlm: a model that is loaded already; the config's when None.

    Raises:
        FileNotFoundError: if the model's folder is not there.
        ValueError: for a model of another class, or words that are not one token each, or the same.
    """

    config_class: ClassVar[type] = PromptReflectorConfig
    config: PromptReflectorConfig

    def __init__(self, config: PromptReflectorConfig, vlm: VideoLanguageModel | None = None) -> None:
        super().__init__(config, vlm)
        self._words = (self.vlm.word(config.no), self.vlm.word(config.yes))
        if self._words[0] == self._words[1]:
            raise ValueError(f"yes and no must be different tokens, got {config.yes!r} and {config.no!r}")

    def judge(self, states: Sequence[Tensor]) -> Tensor:
        return self.vlm.logits(torch.stack([row[-1] for row in states]), self._words).softmax(-1)[:, 1]


def _without_frozen(module: nn.Module, state: dict[str, Any], prefix: str, _: Any) -> None:
    for name in [name for name in state if name.startswith(f"{prefix}vlm.")]:
        del state[name]


def _frozen_is_not_missing(module: nn.Module, keys: Any) -> None:
    keys.missing_keys[:] = [name for name in keys.missing_keys if "vlm" not in name.split(".")]
