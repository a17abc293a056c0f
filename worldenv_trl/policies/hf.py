"""OpenVLA-OFT's recipe (arXiv:2502.19645) over a Hugging Face vision-language model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM
from worldenv_trl.policies.heads import MLPResNet
from worldenv_trl.policies.hf_backbone import VisionLanguageBackbone, autocast
from worldenv_trl.policies.vision_language import VisionLanguageConfig, VisionLanguagePolicy

if TYPE_CHECKING:
    from tokenizers import Tokenizer
    from transformers import PreTrainedModel

    from worldenv_trl.policies.prismatic import PrismaticModel

__all__ = ["HFConfig", "HFPolicy"]


@dataclass(frozen=True)
class HFConfig(VisionLanguageConfig):
    """What an :class:`HFPolicy` is made of, and trained for.

    Args:
        backbone, instructions, cameras, image_size, chunk_length, proprio, resolution, rotation, mirror, crop_area,
            image_mean, image_std, prompt, prompt_end, proprio_format, fixed_statistics, lora_rank, lora_alpha, dtype,
            gradient_checkpointing: see :class:`~worldenv_trl.policies.vision_language.VisionLanguageConfig`.
        attention: ``prefix`` or ``full``; see :class:`~worldenv_trl.policies.hf_backbone.VisionLanguageBackbone`.
        stop_id: of a token behind the placeholders; none when -1.
        readout_shift: how many tokens before the placeholders the first hidden state is read (OpenVLA-OFT: 1).
        head_dim: width of both heads; that of the language model when 0.
        head_blocks: residual blocks of both heads.
        log_scale_init: the log-scale before training.

    Raises:
        ValueError: for a size, an attention, a prompt or a family that cannot be built.
    """

    attention: str = "full"
    stop_id: int = -1
    readout_shift: int = 0
    head_dim: int = 0
    head_blocks: int = 2
    log_scale_init: float = -3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.attention not in ("prefix", "full"):
            raise ValueError(f"attention must be 'prefix' or 'full', got {self.attention!r}")


class HFPolicy(VisionLanguagePolicy):
    """Maps images, proprioception and the instruction to the Laplace parameters of an action chunk.

    One pass of a vision-language model over the images, a token of proprioception, the prompt and a placeholder for
    each number of the chunk; two MLPResNet heads turn the placeholders' hidden states into ``loc`` and ``log_scale``.
    Families: :data:`~worldenv_trl.policies.hf_backbone.FAMILIES`.

    Args:
        config: its settings.
        tokenizer: of the backbone; saved beside the weights as ``tokenizer.json``.
        model: the backbone without its language-modelling head, as ``AutoModelForImageTextToText...model``; with
            random weights when None. :meth:`from_backbone` reads a folder of pretrained ones.

    Raises:
        ValueError: if the tokenizer lacks a token that the family needs.
    """

    config_class = HFConfig
    config: HFConfig
    action_center: Tensor
    action_gain: Tensor

    def __init__(
        self, config: HFConfig, tokenizer: Tokenizer, model: PreTrainedModel | PrismaticModel | None = None
    ) -> None:
        super().__init__(config, tokenizer)
        model, tokens = self._make_model(model)
        self.backbone = VisionLanguageBackbone(
            model,
            **tokens,
            attention=config.attention,
            stop_id=config.stop_id if config.stop_id >= 0 else None,
            readout_shift=config.readout_shift,
        )
        dim = self.backbone.dim
        self.proprio_projector = nn.Sequential(nn.Linear(self._proprio_dim, dim), nn.GELU(), nn.Linear(dim, dim))
        sizes = (ACTION_DIM * dim, config.head_dim or dim, ACTION_DIM, config.head_blocks)
        self.loc_head = MLPResNet(*sizes, out_bias=0.0, out_gain=0.1)
        self.scale_head = MLPResNet(*sizes, out_bias=config.log_scale_init, out_gain=0.01)
        self._prepare_learning()
        self.register_buffer("action_center", torch.zeros(ACTION_DIM))
        self.register_buffer("action_gain", torch.ones(ACTION_DIM))

    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        pixels = self._pixels(images)
        ids, valid = self._prompt_tensors(instructions)
        proprio = self._normalized_proprio(state)
        with autocast(state.device, self._dtype):
            hidden = self.backbone(
                pixels, self.proprio_projector(proprio), ids, valid, self.chunk_length * ACTION_DIM
            )  # [n, C * 7, dim]
        hidden = hidden.float().unflatten(1, (self.chunk_length, ACTION_DIM)).flatten(2)  # [n, C, 7 * dim]
        return self.loc_head(hidden) * self.action_gain + self.action_center, self.scale_head(hidden)

    def scale_parameters(self) -> list[nn.Parameter]:
        return list(self.scale_head.parameters())

    def head_parameters(self) -> list[nn.Parameter]:
        """The projector of proprioception and both heads."""
        return [
            *self.proprio_projector.parameters(),
            *self.loc_head.parameters(),
            *self.scale_head.parameters(),
        ]

    def _set_action_bounds(self, center: Tensor, half: Tensor) -> None:
        self.action_center.copy_(center)
        self.action_gain.copy_(half)
