"""A compact policy after OpenVLA-OFT (arXiv:2502.19645): parallel decoding, chunked actions, an L1 head."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM, CHUNK_LENGTH, STATE_DIM
from worldenv_trl.language import Vocabulary, split_words
from worldenv_trl.policies.base import Policy, check_rank
from worldenv_trl.policies.heads import MLPResNet
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.vision import PretrainedEncoder

__all__ = ["OFTConfig", "OFTPolicy"]


@dataclass(frozen=True)
class OFTConfig:
    """What an :class:`OFTPolicy` is trained for, and its sizes.

    Args:
        instructions: those it is trained on, one at least.
        cameras: scene cameras it looks through; each has a stem and keypoints of its own.
        image_size: height and width of the images in pixels, a multiple of 4.
        chunk_length: actions of a decision.
        proprio: what the state tells, ``commanded`` or ``measured``.
        stem_widths: channels of the stem's convolutions, at least two; the first two halve the image.
        num_keypoints: tokens of each image.
        vision_blocks: blocks of a frozen :class:`~worldenv_trl.vision.PretrainedEncoder` whose features join the
            stem's; none when empty. :func:`~worldenv_trl.vision.load_vision` brings its weights.
        vision_width: channels that these features become.
        dim, depth, num_heads, mlp_ratio: the transformer.
        head_dim, head_blocks: the two MLPResNet heads.
        log_scale_init: the log-scale before training.
        max_words: longest instruction of the training; of a longer one, the words behind are not read.
        vocabulary: words; those of the instructions when empty. Other words become ``<unk>``.
        lora_rank: of the adapters on the backbone's linear layers, 0 is none; set by
            :meth:`OFTPolicy.post_training_parameters`.

    Raises:
        ValueError: for a size that cannot be built.
    """

    instructions: tuple[str, ...]
    cameras: tuple[str, ...] = ("agentview",)
    image_size: int = 64
    chunk_length: int = CHUNK_LENGTH
    proprio: str = "commanded"
    stem_widths: tuple[int, ...] = (32, 32, 48)
    num_keypoints: int = 24
    vision_blocks: tuple[int, ...] = ()
    vision_width: int = 32
    dim: int = 128
    depth: int = 2
    num_heads: int = 4
    mlp_ratio: int = 2
    head_dim: int = 256
    head_blocks: int = 1
    log_scale_init: float = -3.0
    max_words: int = 16
    vocabulary: tuple[str, ...] = ()
    lora_rank: int = 0

    def __post_init__(self) -> None:
        if not self.instructions:
            raise ValueError("instructions must name at least one task's instruction, got none")
        for text in self.instructions:
            if len(split_words(text)) > self.max_words:
                raise ValueError(f"max_words={self.max_words} is less than the words of the instruction {text!r}")
        if self.image_size < 16 or self.image_size % 4:
            raise ValueError(f"image_size must be a multiple of 4 px and at least 16, got {self.image_size}")
        if self.depth < 1:
            raise ValueError(f"depth must be at least 1, got {self.depth}")
        if len(self.stem_widths) < 2:
            raise ValueError(f"stem_widths needs two entries at least, got {self.stem_widths}")
        if self.dim < 1 or self.num_heads < 1 or self.dim % self.num_heads:
            raise ValueError(f"dim must be a positive multiple of num_heads={self.num_heads}, got {self.dim}")
        if not self.vocabulary:
            object.__setattr__(self, "vocabulary", Vocabulary.of(self.instructions))


class _Attention(nn.Module):
    def __init__(self, dim: int, num_heads: int):
        super().__init__()
        self.num_heads = num_heads
        self.query = nn.Linear(dim, dim)
        self.key_value = nn.Linear(dim, 2 * dim)
        self.out = nn.Linear(dim, dim)

    def forward(self, queries: Tensor, tokens: Tensor, pad: Tensor) -> Tensor:
        batch, num_queries, dim = queries.shape
        q = self.query(queries).view(batch, num_queries, self.num_heads, -1).transpose(1, 2)
        key, value = self.key_value(tokens).view(batch, tokens.shape[1], 2, self.num_heads, -1).unbind(2)
        # Additive float mask: the fused CPU kernel takes it without materialising the attention matrix.
        out = F.scaled_dot_product_attention(q, key.transpose(1, 2), value.transpose(1, 2), attn_mask=pad)
        return self.out(out.transpose(1, 2).reshape(batch, num_queries, dim))


class _Block(nn.Module):
    """Pre-norm transformer block; ``last`` rows only, when the others' outputs are not read again."""

    def __init__(self, config: OFTConfig):
        super().__init__()
        dim = config.dim
        self.norm_attention = nn.LayerNorm(dim)
        self.attention = _Attention(dim, config.num_heads)
        self.norm_mlp = nn.LayerNorm(dim)
        self.mlp_in = nn.Linear(dim, config.mlp_ratio * dim)
        self.mlp_out = nn.Linear(config.mlp_ratio * dim, dim)

    def forward(self, tokens: Tensor, pad: Tensor, last: int | None = None) -> Tensor:
        normed = self.norm_attention(tokens)
        if last is not None:
            tokens, queries = tokens[:, -last:], normed[:, -last:]
        else:
            queries = normed
        tokens = tokens + self.attention(queries, normed, pad)
        return tokens + self.mlp_out(F.gelu(self.mlp_in(self.norm_mlp(tokens))))


class _Keypoints(nn.Module):
    """Image tokens: where something is, and what is there.

    A convolutional stem, modulated by the instruction (FiLM, as in OFT+), gives one attention map per token. A token's
    position is the map's mean (spatial softmax, arXiv:1504.00702), its content the features under the map
    (TokenLearner, arXiv:2106.11297). Positions follow the objects by construction, and there are fewer tokens than
    patches, which halves the cost. The first one's map is where the policy takes the hand to go, where it is taught to
    (:class:`~worldenv_trl.objectives.AimedCloning`).
    """

    def __init__(self, config: OFTConfig, vision_widths: Sequence[int]):
        super().__init__()
        widths = (3, *config.stem_widths)
        extra = config.vision_width if vision_widths else 0
        self.stem = nn.ModuleList(
            # Two halvings, then full resolution: the finer the maps, the finer the positions.
            nn.Conv2d(
                fan_in + (extra if i == len(widths) - 2 else 0),
                fan_out,
                5 if i == 0 else 3,
                stride=2 if i < 2 else 1,
                padding=2 if i == 0 else 1,
            )
            for i, (fan_in, fan_out) in enumerate(itertools.pairwise(widths))
        )
        self.vision = nn.ModuleList(nn.Conv2d(width, extra, 1) for width in vision_widths)
        self.film = nn.Linear(config.dim, 2 * widths[-1])
        nn.init.normal_(self.film.weight, std=0.1)
        nn.init.zeros_(self.film.bias)
        self.maps = nn.Conv2d(widths[-1], config.num_keypoints, 1, bias=False)  # softmax does not see a bias
        self.log_sharpness = nn.Parameter(torch.ones(()))
        side = torch.linspace(-1, 1, config.image_size // 4)
        grid = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1).flatten(0, 1)
        self.register_buffer("grid", grid, persistent=False)  # [P, 2]: row, column
        self.position = nn.Linear(2, config.dim)
        self.content = nn.Linear(widths[-1], config.dim)
        self.slot = nn.Parameter(torch.randn(config.num_keypoints, config.dim) * 0.2)

    def forward(self, image: Tensor, pretrained: Sequence[Tensor], sentence: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """[B, 3, H, W], maps [B, w, h', w'], [B, dim] -> tokens [B, K, dim], their positions [B, K, 2] in [-1, 1], and
        the first one's map before its softmax [B, h, w]."""
        features = image
        for conv in self.stem[:-1]:
            features = F.relu(conv(features))
        if pretrained:
            size = features.shape[-2:]
            narrowed = (conv(maps) for conv, maps in zip(self.vision, pretrained, strict=True))
            resized = [F.interpolate(maps, size, mode="bilinear", align_corners=False) for maps in narrowed]
            features = torch.cat([features, F.relu(torch.stack(resized).sum(0))], 1)
        gain, bias = self.film(sentence)[:, :, None, None].chunk(2, 1)
        features = F.relu(self.stem[-1](features) * (1 + gain) + bias)
        maps = self.maps(features) * self.log_sharpness.exp()
        attention = maps.flatten(2).softmax(-1)  # [B, K, P]
        positions = attention @ self.grid
        content = attention @ features.flatten(2).mT
        return self.position(positions) + self.content(content) + self.slot, positions, maps[:, 0]


class _Backbone(nn.Module):
    """Images, instruction, proprioception and action queries in one bidirectional transformer."""

    def __init__(self, config: OFTConfig):
        super().__init__()
        self.config = config
        self.words = nn.Embedding(len(config.vocabulary), config.dim, padding_idx=0)
        nn.init.normal_(self.words.weight, std=0.3)
        self.word_position = nn.Parameter(torch.randn(config.max_words, config.dim) * 0.02)
        self.vision = PretrainedEncoder(config.vision_blocks) if config.vision_blocks else None
        widths = () if self.vision is None else self.vision.widths
        self.keypoints = nn.ModuleList(_Keypoints(config, widths) for _ in config.cameras)
        self.proprio_in = nn.Linear(STATE_DIM, config.dim)
        self.proprio_out = nn.Linear(config.dim, config.dim)
        self.queries = nn.Parameter(torch.randn(config.chunk_length, config.dim) * 0.2)
        # Each query starts from a linear readout of all positions: lower L1 error on unseen expert episodes.
        positions = 2 * config.num_keypoints * len(config.cameras)
        self.readout = nn.Linear(positions + STATE_DIM, config.chunk_length * config.dim)
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.dim)

    def forward(
        self, images: Sequence[Tensor], state: Tensor, words: Tensor
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Images of each camera, uint8 [B, 3, H, W], state [B, 7], words int [B, L] -> [B, C, dim], where each camera's
        first keypoint and the hand are [B, 2 cameras + 3], and that keypoint's map [B, h, w] of each camera."""
        padded = words == 0
        text = self.words(words) * ~padded[..., None]  # [B, L, dim]
        sentence = text.sum(1) / (~padded).sum(1, keepdim=True).clamp(min=1)
        seen = [
            keypoints(image.float() / 127.5 - 1, self.vision(image) if self.vision is not None else (), sentence)
            for keypoints, image in zip(self.keypoints, images, strict=True)
        ]
        patches, positions, aims = zip(*seen, strict=True)
        proprio = self.proprio_out(F.gelu(self.proprio_in(state)))[:, None]
        readout = self.readout(torch.cat([*(where.flatten(1) for where in positions), state], -1))
        queries = self.queries + readout.unflatten(-1, self.queries.shape)
        tokens = torch.cat([text + self.word_position[: words.shape[1]], *patches, proprio, queries], 1)
        pad = F.pad(padded, (0, tokens.shape[1] - words.shape[1]))[:, None, None]
        pad = torch.zeros_like(pad, dtype=tokens.dtype).masked_fill(pad, float("-inf"))
        for block in self.blocks[:-1]:
            tokens = block(tokens, pad)
        places = torch.cat([*(where[:, 0] for where in positions), state[:, :3]], -1)
        return self.norm(self.blocks[-1](tokens, pad, last=self.config.chunk_length)), places, aims


class _Follow(nn.Module):
    """What actions add up from places: gains that each action's hidden state gives, on sines and cosines of places.

    A centimetre is a pixel here, .03 of what positions span. Through the transformer alone such a difference reaches
    the actions so faintly that a policy of five demonstrations a task closed its hand at the same place wherever
    the thing stood, although the keypoint followed it to a quarter of a pixel. (Fourier features, arXiv:2006.10739.)
    """

    octaves = 4  # the finest wave is 8 px of 64 long

    def __init__(self, dim: int, places: int):
        super().__init__()
        self.gains = nn.Linear(dim, ACTION_DIM * 2 * self.octaves * places)
        nn.init.normal_(self.gains.weight, std=0.01)
        nn.init.zeros_(self.gains.bias)

    def forward(self, hidden: Tensor, places: Tensor) -> Tensor:
        """[B, C, dim], [B, P] -> [B, C, 7]."""
        angles = places[..., None] * (torch.pi * 2.0 ** torch.arange(self.octaves, device=places.device))
        waves = torch.cat([angles.sin(), angles.cos()], -1).flatten(-2)
        terms = self.gains(hidden).unflatten(-1, (ACTION_DIM, -1)) * waves[:, None, None]
        return terms.sum(-1) / waves.shape[-1] ** 0.5  # so that an optimiser's step moves actions as far as elsewhere


class OFTPolicy(Policy, Pretrained):
    """Maps images, the proprioception and the instruction to the Laplace parameters of an action chunk.

    Proprioception and actions are mapped to [-1, 1] by bounds that :meth:`fit_statistics` takes from the
    demonstrations (the 1 % and 99 % quantiles, as in OpenVLA-OFT) and that are saved with the weights. An instruction
    that it was not trained on is answered with a warning, by the words that it knows.

    Examples:
        >>> from tensordict import NonTensorStack, TensorDict
        >>> policy = OFTPolicy(OFTConfig(instructions=("open the top drawer", "turn on the stove")))
        >>> observation = {"image": torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(2, 7)}
        >>> texts = NonTensorStack("open the top drawer", "turn on the stove")
        >>> out = policy(TensorDict({"observation": observation, "language_instruction": texts}, [2]))
        >>> out["vla_action", "loc"].shape, out["vla_action", "log_scale"].shape
        (torch.Size([2, 8, 7]), torch.Size([2, 8, 7]))
        >>> groups = policy.post_training_parameters(rank=4)
        >>> list(groups)
        ['adapters', 'heads']
    """

    config_class = OFTConfig
    config: OFTConfig
    state_center: Tensor
    state_half_range: Tensor
    action_center: Tensor

    def __init__(self, config: OFTConfig):
        super().__init__(
            cameras=config.cameras,
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            proprio=config.proprio,
            instructions=config.instructions,
        )
        self.config = config
        self._aims: dict[str, Tensor] | None = None
        self.vocabulary = Vocabulary(config.vocabulary, config.max_words)
        self._longest = self.vocabulary.ids(config.instructions).shape[1]
        self.backbone = _Backbone(config)
        sizes = (config.dim, config.head_dim, ACTION_DIM, config.head_blocks)
        self.loc_head = MLPResNet(*sizes, out_bias=0.0, out_gain=0.1)
        self.follow_head = _Follow(config.dim, 2 * len(config.cameras) + 3)
        self.scale_head = MLPResNet(*sizes, out_bias=config.log_scale_init, out_gain=0.01)
        self.register_buffer("state_center", torch.zeros(STATE_DIM))
        self.register_buffer("state_half_range", torch.ones(STATE_DIM))
        self.register_buffer("action_center", torch.zeros(ACTION_DIM))
        if config.lora_rank:
            self._inject_adapters()

    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        words = self._words(instructions)
        seen = [images[camera] for camera in self.cameras]
        hidden, places, aims = self.backbone(seen, (state - self.state_center) / self.state_half_range, words)
        if self._aims is not None:
            log_probs = (maps.flatten(1).log_softmax(-1).view_as(maps) for maps in aims)
            self._aims.update(zip(self.cameras, log_probs, strict=True))
        loc = self.loc_head(hidden) + self.follow_head(hidden, places)  # hidden is [n, C, dim]
        return loc * self.action_range + self.action_center, self.scale_head(hidden)

    @contextmanager
    def aiming(self) -> Iterator[dict[str, Tensor]]:
        """See :class:`~worldenv_trl.policies.Aims`: the map of each camera's first keypoint."""
        self._aims = {}
        try:
            yield self._aims
        finally:
            self._aims = None

    @torch.compiler.disable  # see Policy._goals
    def _words(self, instructions: Sequence[str]) -> Tensor:
        return self.vocabulary.ids(instructions, self.state_center.device, min_length=self._longest)

    @torch.no_grad()
    def fit_statistics(self, states: Tensor, actions: Tensor) -> None:
        """Takes the bounds of proprioception and actions from data, [..., 7] each.

        Half-ranges are at least .05 (states) and .005 (actions), so that a dimension which hardly moves is not blown up
        into noise. An action's floor also sets how far that dimension answers to a change of the hidden state: at .05,
        rotations that the demonstrations never use took most of LOOP's gradient.

        Raises:
            ValueError: for no data, or numbers that are not finite.
        """
        for name, values, center, half_range, floor in (
            ("states", states, self.state_center, self.state_half_range, 0.05),
            ("actions", actions, self.action_center, self.action_range, 0.005),
        ):
            flat = values.reshape(-1, values.shape[-1]).float()
            if flat.shape[0] == 0 or not torch.isfinite(flat).all():
                raise ValueError(f"{name} must hold at least one row and only finite numbers")
            low, high = torch.quantile(flat, torch.tensor([0.01, 0.99]).to(flat), dim=0)
            center.copy_((low + high) / 2)
            half_range.copy_(((high - low) / 2).clamp(min=floor))

    def scale_parameters(self) -> list[nn.Parameter]:
        return list(self.scale_head.parameters())

    def post_training_parameters(self, rank: int) -> dict[str, list[nn.Parameter]]:
        """Low-rank adapters (peft) on the backbone's linear layers, and both heads; at rank 0 the backbone itself, but
        for the pretrained encoder, instead of adapters."""
        check_rank(rank, self.config.lora_rank)
        if rank and not self.config.lora_rank:
            self.config = dataclasses.replace(self.config, lora_rank=rank)
            self._inject_adapters()
        named = list(self.backbone.named_parameters())
        groups = {"heads": [*self.loc_head.parameters(), *self.follow_head.parameters(), *self.scale_head.parameters()]}
        if rank:
            groups = {"adapters": [each for name, each in named if "lora_" in name]} | groups
        else:
            groups = {"backbone": [each for name, each in named if not name.startswith("vision.")]} | groups
        self.requires_grad_(False)
        for parameter in itertools.chain(*groups.values()):
            parameter.requires_grad_(True)
        return groups

    def _inject_adapters(self) -> None:
        import peft  # imported where used: it takes seconds

        rank = self.config.lora_rank
        targets = [name for name, module in self.backbone.named_modules() if isinstance(module, nn.Linear)]
        lora = peft.LoraConfig(r=rank, lora_alpha=rank, target_modules=targets)  # a gain of one
        device = next(self.backbone.parameters()).device
        peft.inject_adapter_in_model(lora, self.backbone)
        for name, parameter in self.backbone.named_parameters():
            parameter.requires_grad_("lora_" in name)
        self.backbone.to(device)
