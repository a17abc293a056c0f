"""A compact policy after OpenVLA-OFT (arXiv:2502.19645): parallel decoding, chunked actions, an L1 head."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import torch
import torch.nn.functional as F
from torch import nn

from worldenv_trl.keys import ACTION_DIM, CHUNK_LENGTH, STATE_DIM
from worldenv_trl.pretrained import Pretrained

UNKNOWN_WORD = "<unk>"
PAD_WORD = "<pad>"


@dataclass(frozen=True)
class OFTConfig:
    """Sizes and language of an :class:`OFTPolicy`.

    Args:
        instructions: the instruction of every task.
        task_ids: the ``task_id`` of every instruction; 0, 1, 2, ... when empty.
        image_size: height and width of the images in pixels, a multiple of 4.
        stem_widths: channels of the stem's convolutions, at least two; the first two halve the image.
        num_keypoints: image tokens.
        dim, depth, num_heads, mlp_ratio: the transformer.
        head_dim, head_blocks: the two MLPResNet heads.
        vocabulary: words; those of the instructions when empty. Other words become ``<unk>``.
        lora_rank, lora_alpha: adapters on the backbone's linear layers; rank 0 is none. Set by ``add_lora``.
    """

    instructions: tuple[str, ...]
    task_ids: tuple[int, ...] = ()
    image_size: int = 64
    chunk_length: int = CHUNK_LENGTH
    action_dim: int = ACTION_DIM
    state_dim: int = STATE_DIM
    stem_widths: tuple[int, ...] = (32, 32, 48)
    num_keypoints: int = 24
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
    lora_alpha: float = 0.0

    def __post_init__(self) -> None:
        if not self.instructions:
            raise ValueError("instructions must name at least one task's instruction, got none")
        if not self.task_ids:
            object.__setattr__(self, "task_ids", tuple(range(len(self.instructions))))
        if len(self.task_ids) != len(self.instructions) or len(set(self.task_ids)) != len(self.task_ids):
            raise ValueError(
                f"task_ids must be one distinct id for each of the {len(self.instructions)} instructions, "
                f"got {self.task_ids}"
            )
        if self.image_size < 16 or self.image_size % 4:
            raise ValueError(f"image_size must be a multiple of 4 px and at least 16, got {self.image_size}")
        if len(self.stem_widths) < 2 or self.depth < 1:
            raise ValueError(
                f"stem_widths needs two entries and depth one at least, got {self.stem_widths}, {self.depth}"
            )
        if self.dim % self.num_heads:
            raise ValueError(f"dim must be a multiple of num_heads={self.num_heads}, got {self.dim}")
        if not self.vocabulary:
            words = sorted({word for text in self.instructions for word in split_words(text)})
            object.__setattr__(self, "vocabulary", (PAD_WORD, UNKNOWN_WORD, *words))

    @classmethod
    def for_tasks(cls, instructions: Mapping[int, str], **kwargs) -> Self:
        """Config for ``{task_id: instruction}``."""
        return cls(instructions=tuple(instructions.values()), task_ids=tuple(instructions), **kwargs)


def split_words(text: str) -> list[str]:
    """Lower-case words; underscores and punctuation separate."""
    return "".join(c if c.isalnum() else " " for c in text.lower()).split()


class _Attention(nn.Module):
    def __init__(self, dim: int, num_heads: int):
        super().__init__()
        self.num_heads = num_heads
        self.query = nn.Linear(dim, dim)
        self.key_value = nn.Linear(dim, 2 * dim)
        self.out = nn.Linear(dim, dim)

    def forward(self, queries: torch.Tensor, tokens: torch.Tensor, pad: torch.Tensor) -> torch.Tensor:
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

    def forward(self, tokens: torch.Tensor, pad: torch.Tensor, last: int | None = None) -> torch.Tensor:
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
    patches, which halves the cost.
    """

    def __init__(self, config: OFTConfig):
        super().__init__()
        widths = (3, *config.stem_widths)
        self.stem = nn.ModuleList(
            # Two halvings, then full resolution: the finer the maps, the finer the positions.
            nn.Conv2d(fan_in, fan_out, 5 if i == 0 else 3, stride=2 if i < 2 else 1, padding=2 if i == 0 else 1)
            for i, (fan_in, fan_out) in enumerate(itertools.pairwise(widths))
        )
        self.film = nn.Linear(config.dim, 2 * widths[-1])
        nn.init.normal_(self.film.weight, std=0.1)
        nn.init.zeros_(self.film.bias)
        self.maps = nn.Conv2d(widths[-1], config.num_keypoints, 1)
        self.log_sharpness = nn.Parameter(torch.ones(()))
        side = torch.linspace(-1, 1, config.image_size // 4)
        grid = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1).flatten(0, 1)
        self.register_buffer("grid", grid, persistent=False)  # [P, 2]: row, column
        self.position = nn.Linear(2, config.dim)
        self.content = nn.Linear(widths[-1], config.dim)
        self.slot = nn.Parameter(torch.randn(config.num_keypoints, config.dim) * 0.2)

    def forward(self, image: torch.Tensor, sentence: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``[B, 3, H, W]``, ``[B, dim]`` -> tokens ``[B, K, dim]`` and their positions ``[B, K, 2]`` in [-1, 1]."""
        features = image
        for conv in self.stem[:-1]:
            features = F.relu(conv(features))
        gain, bias = self.film(sentence)[:, :, None, None].chunk(2, 1)
        features = F.relu(self.stem[-1](features) * (1 + gain) + bias)
        attention = (self.maps(features).flatten(2) * self.log_sharpness.exp()).softmax(-1)  # [B, K, P]
        positions = attention @ self.grid
        content = attention @ features.flatten(2).mT
        return self.position(positions) + self.content(content) + self.slot, positions


class _Backbone(nn.Module):
    """Image, instruction, proprioception and action queries in one bidirectional transformer."""

    def __init__(self, config: OFTConfig):
        super().__init__()
        self.config = config
        self.words = nn.Embedding(len(config.vocabulary), config.dim, padding_idx=0)
        nn.init.normal_(self.words.weight, std=0.3)
        self.word_position = nn.Parameter(torch.randn(config.max_words, config.dim) * 0.02)
        self.keypoints = _Keypoints(config)
        self.proprio_in = nn.Linear(config.state_dim, config.dim)
        self.proprio_out = nn.Linear(config.dim, config.dim)
        self.queries = nn.Parameter(torch.randn(config.chunk_length, config.dim) * 0.2)
        # Each query starts from a linear readout of all positions: lower L1 error on unseen expert episodes.
        self.readout = nn.Linear(2 * config.num_keypoints + config.state_dim, config.chunk_length * config.dim)
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.dim)

    def forward(self, image: torch.Tensor, state: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
        """``image`` float ``[B, 3, H, W]``, ``state`` ``[B, S]``, ``words`` int ``[B, L]`` -> ``[B, C, dim]``."""
        padded = words == 0
        text = self.words(words) * ~padded[..., None]  # [B, L, dim]
        sentence = text.sum(1) / (~padded).sum(1, keepdim=True).clamp(min=1)
        patches, positions = self.keypoints(image, sentence)
        proprio = self.proprio_out(F.gelu(self.proprio_in(state)))[:, None]
        readout = self.readout(torch.cat([positions.flatten(1), state], -1))
        queries = self.queries + readout.unflatten(-1, self.queries.shape)
        tokens = torch.cat([text + self.word_position[: words.shape[1]], patches, proprio, queries], 1)
        pad = F.pad(padded, (0, tokens.shape[1] - words.shape[1]))[:, None, None]
        pad = torch.zeros_like(pad, dtype=tokens.dtype).masked_fill(pad, float("-inf"))
        for block in self.blocks[:-1]:
            tokens = block(tokens, pad)
        return self.norm(self.blocks[-1](tokens, pad, last=self.config.chunk_length))


class _Head(nn.Module):
    """MLPResNet of OpenVLA-OFT: LN-Linear-ReLU, pre-norm residual blocks, LN-Linear."""

    def __init__(self, config: OFTConfig, out_bias: float, out_gain: float):
        super().__init__()
        self.norm_in = nn.LayerNorm(config.dim)
        self.linear_in = nn.Linear(config.dim, config.head_dim)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(config.head_dim), nn.Linear(config.head_dim, config.head_dim), nn.ReLU())
            for _ in range(config.head_blocks)
        )
        self.norm_out = nn.LayerNorm(config.head_dim)
        self.linear_out = nn.Linear(config.head_dim, config.action_dim)
        nn.init.xavier_uniform_(self.linear_out.weight, gain=out_gain)
        nn.init.constant_(self.linear_out.bias, out_bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = F.relu(self.linear_in(self.norm_in(x)))
        for block in self.blocks:
            x = x + block(x)
        return self.linear_out(self.norm_out(x))


class OFTPolicy(nn.Module, Pretrained):
    """Maps an image, the proprioception and the task to the Laplace parameters of an action chunk.

    Proprioception and actions are mapped to [-1, 1] by bounds that :meth:`fit_statistics` takes from the
    demonstrations (the 1 % and 99 % quantiles, as in OpenVLA-OFT) and that are saved with the weights.

    Examples:
        >>> policy = OFTPolicy(OFTConfig(instructions=("open the top drawer", "turn on the stove")))
        >>> image = torch.zeros(5, 3, 64, 64, dtype=torch.uint8)
        >>> loc, log_scale = policy(image, torch.zeros(5, 7), torch.ones(5, 1, dtype=torch.int64))
        >>> loc.shape, log_scale.shape
        (torch.Size([5, 8, 7]), torch.Size([5, 8, 7]))
    """

    config_class = OFTConfig

    def __init__(self, config: OFTConfig):
        super().__init__()
        self.config = config
        self._word_ids = {word: i for i, word in enumerate(config.vocabulary)}
        self.backbone = _Backbone(config)
        self.loc_head = _Head(config, out_bias=0.0, out_gain=0.1)
        self.scale_head = _Head(config, out_bias=config.log_scale_init, out_gain=0.01)
        self.register_buffer("state_center", torch.zeros(config.state_dim))
        self.register_buffer("state_half_range", torch.ones(config.state_dim))
        self.register_buffer("action_center", torch.zeros(config.action_dim))
        self.register_buffer("action_half_range", torch.ones(config.action_dim))
        table = torch.full((max(config.task_ids) + 1,), -1, dtype=torch.int64)
        table[list(config.task_ids)] = torch.arange(len(config.task_ids))
        self.register_buffer("_task_row", table, persistent=False)
        self.register_buffer("_task_words", self.tokenize(config.instructions), persistent=False)
        if config.lora_rank:
            self._inject_lora()

    def forward(
        self,
        image: torch.Tensor,
        state: torch.Tensor,
        task_id: torch.Tensor | None = None,
        *,
        instruction: Sequence[str] | str | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The chunk's Laplace parameters.

        Args:
            image: uint8 ``[*B, 3, H, W]``.
            state: float32 ``[*B, 7]``, metres, radians, gripper opening.
            task_id: int64 ``[*B, 1]``, one of ``config.task_ids``; or
            instruction: one text for all rows, or one for each of the flattened rows.

        Returns:
            ``loc`` and ``log_scale``, float32 ``[*B, C, 7]``, in the env's normalised action units.
        """
        config = self.config
        batch = state.shape[:-1]
        if image.dtype != torch.uint8 or image.shape[-3:] != (3, config.image_size, config.image_size):
            raise ValueError(
                f"image must be uint8 [*B, 3, {config.image_size}, {config.image_size}], "
                f"got {image.dtype} {list(image.shape)}"
            )
        if image.shape[:-3] != batch or state.shape[-1] != config.state_dim:
            raise ValueError(f"state must be {[*image.shape[:-3], config.state_dim]}, got {list(state.shape)}")
        if (task_id is None) == (instruction is None):
            raise ValueError("pass either task_id or instruction")
        if task_id is not None:
            words = self._task_words[self._rows_of(task_id.reshape(-1))]
        else:
            texts = [instruction] if isinstance(instruction, str) else list(instruction)
            words = self.tokenize(texts).to(state.device)
            words = words.expand(batch.numel(), -1) if len(texts) == 1 else words
        pixels = image.reshape(-1, *image.shape[-3:]).float() / 127.5 - 1
        proprio = (state.reshape(-1, config.state_dim) - self.state_center) / self.state_half_range
        hidden = self.backbone(pixels, proprio, words)  # [B, C, dim]
        loc = self.loc_head(hidden) * self.action_half_range + self.action_center
        log_scale = self.scale_head(hidden)
        shape = (*batch, config.chunk_length, config.action_dim)
        return loc.float().reshape(shape), log_scale.float().reshape(shape)

    def tokenize(self, instructions: Sequence[str]) -> torch.Tensor:
        """Word ids ``[len(instructions), L]``, padded with 0 at the end."""
        rows = []
        for text in instructions:
            words = split_words(text)
            if not 0 < len(words) <= self.config.max_words:
                raise ValueError(f"an instruction must have 1 to {self.config.max_words} words, got {text!r}")
            rows.append([self._word_ids.get(word, self._word_ids[UNKNOWN_WORD]) for word in words])
        length = max(len(row) for row in rows)
        return torch.tensor([row + [0] * (length - len(row)) for row in rows])

    def _rows_of(self, task_id: torch.Tensor) -> torch.Tensor:
        known = (task_id >= 0) & (task_id < self._task_row.shape[0])
        rows = torch.where(known, self._task_row[task_id.clamp(0, self._task_row.shape[0] - 1)], -1)
        if not torch.compiler.is_compiling() and bool((rows < 0).any()):
            unknown = sorted(set(task_id[rows < 0].tolist()))
            raise ValueError(
                f"task_id {unknown} is not among the tasks this policy was built for, {self.config.task_ids}; "
                "pass the instruction as text instead"
            )
        return rows

    @torch.no_grad()
    def fit_statistics(self, states: torch.Tensor, actions: torch.Tensor) -> None:
        """Takes the bounds of proprioception and actions from data, ``[..., 7]`` each.

        Half-ranges are at least .05 (states) and .005 (actions), so that a dimension which hardly moves is not blown up
        into noise. An action's floor also sets how far that dimension answers to a change of the hidden state: at .05,
        rotations that the demonstrations never use took most of LOOP's gradient.
        """
        for name, values, floor in (("state", states, 0.05), ("action", actions, 0.005)):
            flat = values.reshape(-1, values.shape[-1]).float()
            if flat.shape[0] == 0 or not torch.isfinite(flat).all():
                raise ValueError(f"{name}s must hold at least one row and only finite numbers")
            low, high = torch.quantile(flat, torch.tensor([0.01, 0.99]).to(flat), dim=0)
            getattr(self, f"{name}_center").copy_((low + high) / 2)
            getattr(self, f"{name}_half_range").copy_(((high - low) / 2).clamp(min=floor))

    def backbone_parameters(self) -> Iterator[nn.Parameter]:
        """Everything but the heads, adapters included."""
        return self.backbone.parameters()

    def loc_head_parameters(self) -> Iterator[nn.Parameter]:
        return self.loc_head.parameters()

    def scale_head_parameters(self) -> Iterator[nn.Parameter]:
        return self.scale_head.parameters()

    def head_parameters(self) -> Iterator[nn.Parameter]:
        """Both heads."""
        yield from self.loc_head.parameters()
        yield from self.scale_head.parameters()

    def lora_parameters(self) -> Iterator[nn.Parameter]:
        return (parameter for name, parameter in self.backbone.named_parameters() if "lora_" in name)

    def add_lora(self, rank: int, alpha: float | None = None) -> Self:
        """Freezes the backbone and adds low-rank adapters (peft) to its linear layers; the heads are left as they are.

        The output does not change until the adapters are trained. ``alpha`` defaults to ``rank`` (a gain of one).
        Build losses and optimisers after this call.
        """
        if self.config.lora_rank:
            raise ValueError(f"this policy already has LoRA of rank {self.config.lora_rank}")
        if rank < 1:
            raise ValueError(f"rank must be at least 1, got {rank}")
        alpha = float(rank if alpha is None else alpha)
        self.config = dataclasses.replace(self.config, lora_rank=rank, lora_alpha=alpha)
        self._inject_lora()
        return self

    def _inject_lora(self) -> None:
        import peft  # imported where used: it takes seconds

        targets = [name for name, module in self.backbone.named_modules() if isinstance(module, nn.Linear)]
        lora = peft.LoraConfig(r=self.config.lora_rank, lora_alpha=self.config.lora_alpha, target_modules=targets)
        device = next(self.backbone.parameters()).device
        peft.inject_adapter_in_model(lora, self.backbone)
        for name, parameter in self.backbone.named_parameters():
            parameter.requires_grad_("lora_" in name)
        self.backbone.to(device)
