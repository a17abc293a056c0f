"""A reflector small enough for a CPU: a frozen convolutional encoder and a reward head."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from worldenv_trl.keys import frames_key, image_entry
from worldenv_trl.language import Vocabulary
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.reflectors.base import Lesson, Reflector
from worldenv_trl.reflectors.compact_lessons import CompactLessons, lessons_of
from worldenv_trl.reflectors.goal import MAX_WORDS, Goal
from worldenv_trl.reflectors.prefixes import prefix_indices
from worldenv_trl.vision import PretrainedEncoder

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes

__all__ = ["CompactReflector", "CompactReflectorConfig"]

_FRAMES_PER_CALL = 64
_DEFAULT_LESSONS = CompactLessons()


@dataclass(frozen=True)
class CompactReflectorConfig:
    """Sizes and goals of a :class:`CompactReflector`.

    Args:
        instructions: those of the training; it knows their words.
        cameras: scene cameras whose frames it looks at.
        image_size: height and width (px), a multiple of 8.
        widths: channels of the encoder's three stride-2 convolutions.
        feature_dim: length of a frame's feature.
        hidden_dim: of the reward head.
        num_frames: most frames of a prefix that are looked at.
        vision_blocks: blocks of a frozen :class:`~worldenv_trl.vision.PretrainedEncoder` that the encoder sees
            through, too; none when empty. :func:`~worldenv_trl.vision.load_vision` brings its weights.

    Raises:
        ValueError: for no instruction, or sizes out of range.
    """

    instructions: tuple[str, ...]
    cameras: tuple[str, ...] = ("agentview",)
    image_size: int = 64
    widths: tuple[int, int, int] = (24, 32, 48)
    feature_dim: int = 96
    hidden_dim: int = 128
    num_frames: int = 32
    vision_blocks: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name in ("instructions", "cameras", "widths", "vision_blocks"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not self.instructions:
            raise ValueError("instructions must name at least one instruction, got none")
        if self.image_size < 16 or self.image_size % 8:
            raise ValueError(f"image_size must be a multiple of 8 px and at least 16, got {self.image_size}")
        if self.num_frames < 2:
            raise ValueError(f"num_frames must be at least 2, the first and the last frame, got {self.num_frames}")


class CompactReflector(Reflector, Pretrained):
    """R(o_1:t, g) from features of up to 32 frames, spread evenly over the video so far.

    The encoder learns to tell success frame by frame and is then frozen; the reward head, which sees the prefix, is
    trained on its features. What either asks of a frame is a function of the instruction's words.

    Args:
        config: sizes and goals.
        lessons: how long it learns in :meth:`train_on`; not saved.

    Examples:
        >>> reflector = CompactReflector(CompactReflectorConfig(("open the drawer",), image_size=16))
        >>> video = {"agentview": torch.zeros(4, 9, 3, 16, 16, dtype=torch.uint8)}
        >>> state = reflector.begin({"agentview": video["agentview"][:, 0]}, ["open the drawer"] * 4)
        >>> state, scores = reflector.extend(state, {"agentview": video["agentview"][:, 1:]})
        >>> scores.shape, state["features"].shape
        (torch.Size([4, 8]), torch.Size([4, 9, 96]))
    """

    config_class = CompactReflectorConfig

    def __init__(self, config: CompactReflectorConfig, lessons: CompactLessons = _DEFAULT_LESSONS) -> None:
        super().__init__(cameras=config.cameras, image_size=config.image_size, instructions=config.instructions)
        self.config, self.lessons = config, lessons
        self.vocabulary = Vocabulary(Vocabulary.of(config.instructions), MAX_WORDS)
        words, dim, hidden = len(self.vocabulary.words), config.feature_dim, config.hidden_dim
        self.encoder = _Encoder(config)
        self.frame_hidden = nn.Sequential(nn.Linear(2 * dim, hidden), nn.GELU())
        self.frame_goal = Goal(words, dim, hidden + 1, scale=(3 * hidden) ** -0.5)
        self.query = Goal(words, dim, dim, scale=1.0)
        self.key = nn.Linear(dim, dim, bias=False)  # a bias would add the same to all frames of a prefix
        self.age = nn.Parameter(torch.zeros(config.num_frames))
        self.head = nn.Sequential(nn.LayerNorm(6 * dim), nn.Linear(6 * dim, hidden), nn.GELU(), nn.Linear(hidden, 1))

    # ------------------------------------------------------------------------------------------------- judging

    @torch.no_grad()
    def begin(self, frames: Mapping[str, Tensor], instructions: Sequence[str]) -> TensorDict:
        self.seen.check(instructions)
        features = self.encode(frames).unsqueeze(1)
        count = len(features)
        state = TensorDict(
            {
                "features": features,
                "seen": torch.ones(count, dtype=torch.int64, device=features.device),
                "query": self.query(self.vocabulary.ids(instructions, features.device)),
            },
            batch_size=[count],
        )
        return state.set("score", self.logits(features, state["seen"], state["query"]).sigmoid())

    @torch.no_grad()
    def extend(self, state: TensorDictBase, frames: Mapping[str, Tensor]) -> tuple[TensorDict, Tensor]:
        shape = next(iter(frames.values())).shape[:2]  # [n, C]
        new = self.encode({camera: video.flatten(0, 1) for camera, video in frames.items()}).unflatten(0, shape)
        seen, known = state["seen"], state["features"]
        needed = max(known.shape[1], int(seen.max()) + shape[1])
        features = new.new_zeros(shape[0], needed, new.shape[-1])
        features[:, : known.shape[1]] = known
        place = seen.unsqueeze(-1) + torch.arange(shape[1], device=seen.device)
        features[torch.arange(shape[0], device=seen.device).unsqueeze(-1), place] = new
        scores = self._prefix_scores(features, place + 1, state["query"])
        grown = {"features": features, "seen": seen + shape[1], "query": state["query"], "score": scores[:, -1]}
        return TensorDict(grown, batch_size=[shape[0]]), scores

    @torch.no_grad()
    def encode(self, frames: Mapping[str, Tensor]) -> Tensor:
        """Features [n, F] of frames uint8 [n, 3, H, W] by camera; never differentiated.

        Raises:
            ValueError: for a camera that is missing, or another size.
        """
        size, images = (3, self.config.image_size, self.config.image_size), []
        for camera in self.cameras:
            if camera not in frames:
                raise ValueError(f"the reflector looks at {camera!r}, the frames are of {', '.join(frames)}")
            if tuple(frames[camera].shape[1:]) != size:
                raise ValueError(
                    f"frames of {camera!r} must be [n, 3, {size[1]}, {size[2]}], got {list(frames[camera].shape)}"
                )
            images.append(frames[camera])
        # On a CPU, calls whose activations fit the cache are nearly three times as fast.
        count = _FRAMES_PER_CALL if images[0].device.type == "cpu" else max(1, len(images[0]))
        parts = zip(*(image.split(count) for image in images), strict=True)
        return torch.cat([self.encoder(part) for part in parts])

    def _prefix_scores(self, features: Tensor, lengths: Tensor, query: Tensor) -> Tensor:
        """Scores of the prefixes of ``lengths`` [n, C] frames of ``features`` [n, T, F], in one batch: [n, C]."""
        rows = torch.arange(len(features), device=lengths.device).repeat_interleave(lengths.shape[1])
        sampled, used = self.sample_prefixes(features, rows, lengths.flatten())
        return self.logits(sampled, used, query[rows]).sigmoid().reshape(lengths.shape)

    def sample_prefixes(self, features: Tensor, rows: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        """Evenly sampled frames of prefixes: [P, L, F], and how many are in use, [P].

        Args:
            features: [R, T, F] of whole videos.
            rows: int64 [P], the video of each prefix.
            lengths: int64 [P], its number of frames.
        """
        index = prefix_indices(lengths, self.config.num_frames)
        return features[rows.unsqueeze(-1), index], lengths.clamp(max=index.shape[1])

    def logits(self, features: Tensor, lengths: Tensor, query: Tensor) -> Tensor:
        """Log-odds [P] that the task is done.

        Args:
            features: [P, L, F], sampled frames of each prefix in order, short ones padded at the end.
            lengths: int64 [P], frames in use.
            query: [P, F], of the instructions.
        """
        rows = torch.arange(len(features), device=features.device)
        last_index = lengths - 1
        slots = torch.arange(features.shape[1], device=features.device)
        age = last_index.unsqueeze(-1) - slots  # [P, L]
        attention = (features @ (query @ self.key.weight).unsqueeze(-1)).squeeze(-1) / features.shape[-1] ** 0.5
        attention = attention + self.age[age.clamp(0, self.config.num_frames - 1)]
        attention = attention.masked_fill(age < 0, float("-inf")).softmax(-1)
        pooled = (attention.unsqueeze(1) @ features).squeeze(1)
        last, first = features[rows, last_index], features[:, 0]
        before = features[rows, (last_index - 1).clamp(min=0)]
        return self.head(torch.cat([last, first, last - first, last - before, pooled, query], -1)).squeeze(-1)

    # ------------------------------------------------------------------------------------------------- learning

    def encoder_parameters(self) -> list[nn.Parameter]:
        """What is trained first and then frozen; a pretrained encoder is frozen from the start."""
        own = [parameter for name, parameter in self.encoder.named_parameters() if not name.startswith("vision.")]
        return [*own, *_parameters(self.frame_hidden, self.frame_goal)]

    def head_parameters(self) -> list[nn.Parameter]:
        """The reward head."""
        return [self.age, *_parameters(self.query, self.key, self.head)]

    def train_on(self, episodes: Episodes) -> Iterator[Lesson]:
        """First ``encoder``, on single frames; then, with the encoder frozen, ``head``, on prefixes of its features.

        Batches are balanced over tasks and outcomes. Frames are read as they are drawn, and once in parts for the
        features of the second lesson, which stay in memory.

        Raises:
            ValueError: at once, for episodes without labels, of other cameras or sizes, or of an instruction that the
                config does not name.
        """
        return lessons_of(self, episodes)

    def training_loss(self, batch: TensorDictBase) -> TensorDict:
        """Binary cross-entropy against whether the goal holds: of prefixes, or of single frames.

        Args:
            batch: [P] with ``words`` int64 [P, L], ``label`` bool [P, 1], and either ``features`` [P, L, F] and
                ``lengths`` int64 [P, 1], or ``("frames", entry)`` and ``("first", entry)``, floats in [0, 255],
                [P, 3, H, W] by camera: a frame and the first of its video.
        """
        prefixes = "features" in batch.keys()  # noqa: SIM118 - a TensorDict iterates over rows
        if prefixes:
            query = self.query(batch["words"])
            logits = self.logits(batch["features"], batch["lengths"].squeeze(-1), query)
        else:
            now = [batch[frames_key(camera)] for camera in self.cameras]
            first = [batch["first", image_entry(camera)] for camera in self.cameras]
            logits = self._frame_logits(now, first, batch["words"])
        label, smoothing = batch["label"].squeeze(-1), self.lessons.label_smoothing if prefixes else 0.0
        loss = F.binary_cross_entropy_with_logits(logits, label.float() * (1 - smoothing) + smoothing / 2)
        accuracy = ((logits.detach() > 0) == label).float().mean()
        return TensorDict({"loss_reflector": loss, "accuracy": accuracy})

    def _frame_logits(self, now: list[Tensor], first: list[Tensor], words: Tensor) -> Tensor:
        """Log-odds [P] of success from one frame and the video's first: the encoder's own lesson."""
        features = self.encoder([torch.cat(pair) for pair in zip(now, first, strict=True)])
        hidden = self.frame_hidden(torch.cat(features.chunk(2), -1))
        goal = self.frame_goal(words)
        return (hidden * goal[:, :-1]).sum(-1) + goal[:, -1]


class _Encoder(nn.Module):
    """Frames, [n, 3, H, W] of each camera with values in [0, 255], to features [n, F]."""

    def __init__(self, config: CompactReflectorConfig) -> None:
        super().__init__()
        first, second, third = config.widths
        cells, dim = (config.image_size // 8) ** 2, config.feature_dim
        self.cameras = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(3, first, 5, stride=2, padding=2), nn.GELU(),
                nn.Conv2d(first, second, 3, stride=2, padding=1), nn.GELU(),
                nn.Conv2d(second, third, 3, stride=2, padding=1), nn.GELU(),
                nn.Flatten(), nn.Linear(third * cells, dim), nn.LayerNorm(dim),
            )
            for _ in config.cameras
        )  # fmt: skip
        self.vision = PretrainedEncoder(config.vision_blocks) if config.vision_blocks else None
        self.pretrained = nn.ModuleList()
        if self.vision is not None:
            sides = [-(-config.image_size // stride) for stride in self.vision.strides]
            inputs = sum(width * side**2 for width, side in zip(self.vision.widths, sides, strict=True))
            for _ in config.cameras:
                self.pretrained.append(nn.Sequential(nn.LayerNorm(inputs), nn.Linear(inputs, dim), nn.LayerNorm(dim)))
        several = len(config.cameras) > 1
        self.together = (
            nn.Sequential(nn.Linear(len(config.cameras) * dim, dim), nn.LayerNorm(dim)) if several else nn.Identity()
        )

    def forward(self, images: Sequence[Tensor]) -> Tensor:
        each = [camera(image.float() / 127.5 - 1) for camera, image in zip(self.cameras, images, strict=True)]
        if self.vision is not None:
            for index, (read, image) in enumerate(zip(self.pretrained, images, strict=True)):
                maps = [each_map.flatten(1) for each_map in self.vision(image)]
                each[index] = each[index] + read(torch.cat(maps, 1))
        return self.together(torch.cat(each, -1))


def _parameters(*modules: nn.Module) -> list[nn.Parameter]:
    return [parameter for module in modules for parameter in module.parameters()]
