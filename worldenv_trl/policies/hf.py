"""OpenVLA-OFT's recipe (arXiv:2502.19645) over a Hugging Face vision-language model."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM, CHUNK_LENGTH, STATE_DIM
from worldenv_trl.policies.base import Policy, check_rank
from worldenv_trl.policies.heads import MLPResNet
from worldenv_trl.policies.hf_backbone import (
    FAMILIES,
    VisionLanguageBackbone,
    autocast,
    backbone_config,
    make_model,
)
from worldenv_trl.policies.images import prepare_images
from worldenv_trl.pretrained import Pretrained

if TYPE_CHECKING:
    from tokenizers import Tokenizer
    from transformers import PreTrainedModel

__all__ = ["HFConfig", "HFPolicy"]

TOKENIZER_NAME = "tokenizer.json"
FINGER_TRAVEL = 0.04  # metres, of each of the Panda's fingers in LIBERO, from closed to open
PROMPT = "In: What action should the robot take to {instruction}?\nOut:"


@dataclass(frozen=True)
class HFConfig:
    """What an :class:`HFPolicy` is made of, and trained for.

    Args:
        backbone: ``to_dict()`` of the transformers config of the vision-language model.
        instructions: those it is trained on; others are answered with a warning. Empty: it never warns.
        cameras: scene cameras it looks through, in order.
        image_size: height and width of the env's images (px).
        chunk_length: actions of a decision.
        proprio: what the state tells, ``commanded`` or ``measured``.
        resolution: side of the images that the backbone sees (px); that of its vision config when 0.
        rotation: of the env's images, in degrees against the clock, before all else.
        mirror: exchange left and right, after the rotation: what a checkpoint of LIBERO learned from.
        crop_area: share of each image's area that is kept, its middle; OpenVLA-OFT keeps 0.9.
        image_mean, image_std: of each channel, as the backbone was pretrained.
        prompt: with ``{instruction}``, which is put in lower case.
        attention: ``prefix`` or ``full``; see :class:`~worldenv_trl.policies.hf_backbone.VisionLanguageBackbone`.
        stop_id: of a token behind the placeholders; none when -1.
        readout_shift: how many tokens before the placeholders the first hidden state is read (OpenVLA-OFT: 1).
        prompt_end: ids of tokens behind every prompt.
        proprio_format: of the proprioception that the backbone sees, ``state``, the env's 7 numbers, or ``libero``, 8
            numbers: the gripper's opening becomes the positions of LIBERO's two fingers (m).
        fixed_statistics: keep the bounds of proprioception and actions that came with a checkpoint, whose heads were
            trained with them: :meth:`HFPolicy.fit_statistics` then changes nothing.
        head_dim: width of both heads; that of the language model when 0.
        head_blocks: residual blocks of both heads.
        log_scale_init: the log-scale before training.
        lora_rank: of the adapters on every linear layer of the backbone; 0 is none, and all of it can learn.
        lora_alpha: their gain times the rank; at most 16 and no more than the rank when 0, as in OpenVLA-OFT.
        dtype: of the backbone's weights and products, ``float32`` or ``bfloat16``; what learns is float32.
        gradient_checkpointing: keep no activations inside the backbone's layers, compute them again.

    Raises:
        ValueError: for a size, an attention, a prompt or a family that cannot be built.
    """

    backbone: Mapping[str, Any] = field(repr=False)
    instructions: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ("agentview",)
    image_size: int = 256
    chunk_length: int = CHUNK_LENGTH
    proprio: str = "commanded"
    resolution: int = 0
    rotation: int = 0
    mirror: bool = False
    crop_area: float = 0.9
    image_mean: tuple[float, ...] = (0.5, 0.5, 0.5)
    image_std: tuple[float, ...] = (0.5, 0.5, 0.5)
    prompt: str = PROMPT
    attention: str = "full"
    stop_id: int = -1
    readout_shift: int = 0
    prompt_end: tuple[int, ...] = ()
    proprio_format: str = "state"
    fixed_statistics: bool = False
    head_dim: int = 0
    head_blocks: int = 2
    log_scale_init: float = -3.0
    lora_rank: int = 32
    lora_alpha: int = 0
    dtype: str = "float32"
    gradient_checkpointing: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "backbone", json.loads(json.dumps(dict(self.backbone))))  # as it is read again
        kind = self.backbone.get("model_type")
        if kind not in FAMILIES:
            raise ValueError(f"the backbone's model_type must be one of {', '.join(FAMILIES)}, got {kind!r}")
        if not self.resolution:
            side = self.backbone.get("vision_config", {}).get("image_size")
            if side is None:
                raise ValueError(f"resolution must be given for {kind}, whose vision config has no image_size")
            object.__setattr__(self, "resolution", int(side))
        if self.attention not in ("prefix", "full"):
            raise ValueError(f"attention must be 'prefix' or 'full', got {self.attention!r}")
        if self.proprio_format not in ("state", "libero"):
            raise ValueError(f"proprio_format must be 'state' or 'libero', got {self.proprio_format!r}")
        if self.dtype not in ("float32", "bfloat16"):
            raise ValueError(f"dtype must be 'float32' or 'bfloat16', got {self.dtype!r}")
        if "{instruction}" not in self.prompt:
            raise ValueError(f"prompt must hold {{instruction}}, got {self.prompt!r}")
        if self.lora_rank < 0 or self.lora_alpha < 0:
            raise ValueError(f"lora_rank and lora_alpha must not be negative, got {self.lora_rank}, {self.lora_alpha}")

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Self:
        """Of a JSON object; the backbone's lists stay lists."""
        plain: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()
        }
        return cls(**plain)


class HFPolicy(Policy, Pretrained):
    """Maps images, proprioception and the instruction to the Laplace parameters of an action chunk.

    One pass of a vision-language model over the images, a token of proprioception, the prompt and a placeholder for
    each number of the chunk; two MLPResNet heads turn the placeholders' hidden states into ``loc`` and ``log_scale``.
    Proprioception and actions are mapped to [-1, 1] by the 1 % and 99 % quantiles that :meth:`fit_statistics` takes
    from data. Families: :data:`~worldenv_trl.policies.hf_backbone.FAMILIES`.

    Args:
        config: its settings.
        tokenizer: of the backbone; saved beside the weights as ``tokenizer.json``.
        model: the backbone without its language-modelling head, as ``AutoModelForImageTextToText...model``; with
            random weights when None. :meth:`from_backbone` reads a folder of pretrained ones.

    Raises:
        ValueError: if the tokenizer lacks a token that the family needs.
    """

    config_class = HFConfig
    companion_names = (TOKENIZER_NAME,)
    config: HFConfig
    action_center: Tensor
    action_gain: Tensor
    state_low: Tensor
    state_high: Tensor

    def __init__(self, config: HFConfig, tokenizer: Tokenizer, model: PreTrainedModel | None = None) -> None:
        super().__init__(
            cameras=config.cameras,
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            proprio=config.proprio,
            instructions=config.instructions,
        )
        self.config, self.tokenizer = config, tokenizer
        self._dtype = getattr(torch, config.dtype)
        if model is None:
            model = make_model(backbone_config(config.backbone), self._dtype)
        family = FAMILIES[model.config.model_type]
        around = tuple(tuple(self._token_id(text) for text in texts) for texts in (family.before, family.after))
        first = tokenizer.encode("", add_special_tokens=True).ids  # what stands before every text
        self.backbone = VisionLanguageBackbone(
            model,
            token_ids=(around[0], around[1]),
            first_id=first[0] if first else None,
            attention=config.attention,
            stop_id=config.stop_id if config.stop_id >= 0 else None,
            readout_shift=config.readout_shift,
        )
        dim = self.backbone.dim
        proprio_dim = STATE_DIM + (config.proprio_format == "libero")
        self.proprio_projector = nn.Sequential(nn.Linear(proprio_dim, dim), nn.GELU(), nn.Linear(dim, dim))
        sizes = (ACTION_DIM * dim, config.head_dim or dim, ACTION_DIM, config.head_blocks)
        self.loc_head = MLPResNet(*sizes, out_bias=0.0, out_gain=0.1)
        self.scale_head = MLPResNet(*sizes, out_bias=config.log_scale_init, out_gain=0.01)
        self.register_buffer("state_low", -torch.ones(proprio_dim))
        self.register_buffer("state_high", torch.ones(proprio_dim))
        self.register_buffer("action_center", torch.zeros(ACTION_DIM))
        self.register_buffer("action_gain", torch.ones(ACTION_DIM))
        self._prompts: dict[str, list[int]] = {}
        self._longest = max(map(len, map(self._prompt_ids, config.instructions)), default=0)
        if config.lora_rank:
            self._inject_adapters()
        if config.gradient_checkpointing:
            # Its older name is deprecated since transformers 5.23.
            enable: Any = getattr(model, "activation_checkpointing_enable", None) or model.gradient_checkpointing_enable
            enable({"use_reentrant": False})
            self.backbone.model.disable_input_require_grads()  # for reentrant checkpoints alone

    @classmethod
    def from_backbone(cls, folder: str | os.PathLike, *, device: str | torch.device = "cpu", **settings: Any) -> Self:
        """A policy over a pretrained vision-language model, with untrained heads.

        Args:
            folder: what transformers' ``save_pretrained`` of model and processor wrote: ``config.json``, safetensors,
                ``tokenizer.json`` and, for mean and deviation of the images, ``preprocessor_config.json``; or
                ``owner/name`` of a repository of the Hub that holds these.

        Keyword Args:
            device: of the parameters; on ``meta`` no weights are read, only that their files are there is checked.
            settings: fields of :class:`HFConfig`.

        Raises:
            FileNotFoundError: if one of these files is missing.
            ValueError: for a family that is not known, another kind of checkpoint (what reads it is said), or settings
                that cannot be.
        """
        from worldenv_trl.policies.hf_files import read_backbone

        fields, tokenizer, model = read_backbone(folder, getattr(torch, settings.get("dtype", "float32")), device)
        policy = cls(HFConfig(**(fields | settings)), tokenizer, model)
        return policy.to(device)

    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        config = self.config
        pixels = torch.stack([images[camera] for camera in self.cameras], 1)  # [n, cameras, 3, H, W]
        pixels = prepare_images(
            pixels,
            config.resolution,
            rotation=config.rotation,
            mirror=config.mirror,
            crop_area=config.crop_area,
            mean=config.image_mean,
            std=config.image_std,
        )
        ids, valid = self._prompt_tensors(instructions)
        span = self.state_high - self.state_low
        proprio = (2 * (self._proprio(state) - self.state_low) / (span + 1e-8) - 1).clamp(-1, 1)
        with autocast(state.device, self._dtype):
            hidden = self.backbone(
                pixels, self.proprio_projector(proprio), ids, valid, self.chunk_length * ACTION_DIM
            )  # [n, C * 7, dim]
        hidden = hidden.float().unflatten(1, (self.chunk_length, ACTION_DIM)).flatten(2)  # [n, C, 7 * dim]
        return self.loc_head(hidden) * self.action_gain + self.action_center, self.scale_head(hidden)

    @torch.no_grad()
    def fit_statistics(self, states: Tensor, actions: Tensor) -> None:
        """Takes the bounds of proprioception and actions from data, [..., 7] each: the 1 % and 99 % quantiles.

        Half of an action's range is at least .005, and of a state's .05: a dimension which hardly moves is not blown up
        into noise. Nothing changes where the config has ``fixed_statistics``.

        Raises:
            ValueError: for no data, or numbers that are not finite.
        """
        bounds = []
        for name, values, floor in (("states", self._proprio(states), 0.05), ("actions", actions, 0.005)):
            flat = values.reshape(-1, values.shape[-1]).float()
            if flat.shape[0] == 0 or not torch.isfinite(flat).all():
                raise ValueError(f"{name} must hold at least one row and only finite numbers")
            low, high = torch.quantile(flat, torch.tensor([0.01, 0.99]).to(flat), dim=0)
            bounds.append(((low + high) / 2, ((high - low) / 2).clamp(min=floor)))
        if self.config.fixed_statistics:
            return
        (center, half), (action_center, action_half) = bounds
        self.state_low.copy_(center - half)
        self.state_high.copy_(center + half)
        self.action_center.copy_(action_center)
        self.action_gain.copy_(action_half)
        self.action_range.copy_(action_half)

    def _proprio(self, state: Tensor) -> Tensor:
        if self.config.proprio_format == "state":
            return state
        finger = FINGER_TRAVEL * state[..., -1:]
        return torch.cat([state[..., :-1], finger, -finger], -1)

    def scale_parameters(self) -> list[nn.Parameter]:
        return list(self.scale_head.parameters())

    def post_training_parameters(self, rank: int) -> dict[str, list[nn.Parameter]]:
        """The adapters (peft) of the backbone's linear layers, and in full both heads and the projector of
        proprioception; at rank 0 the backbone itself instead of adapters."""
        check_rank(rank, self.config.lora_rank)
        if rank and not self.config.lora_rank:
            self.config = dataclasses.replace(self.config, lora_rank=rank)
            self._inject_adapters()
        adapters = [each for name, each in self.backbone.named_parameters() if "lora_" in name]
        groups = {"adapters": adapters} if rank else {"backbone": list(self.backbone.parameters())}
        groups["heads"] = [
            *self.proprio_projector.parameters(),
            *self.loc_head.parameters(),
            *self.scale_head.parameters(),
        ]
        self.requires_grad_(False)
        for parameter in itertools.chain(*groups.values()):
            parameter.requires_grad_(True)
        return groups

    def companions(self) -> dict[str, bytes]:
        return {TOKENIZER_NAME: self.tokenizer.to_str().encode()}

    @classmethod
    def build(cls, config: HFConfig, folder: Path) -> Self:
        from tokenizers import Tokenizer
        from transformers.initialization import no_init_weights

        with no_init_weights():  # billions of random numbers take minutes
            return cls(config, Tokenizer.from_file(str(folder / TOKENIZER_NAME)))

    def _inject_adapters(self) -> None:
        import peft  # imported where used: it takes seconds

        rank, model = self.config.lora_rank, self.backbone.model
        kinds = nn.modules.linear.NonDynamicallyQuantizableLinear  # of nn.MultiheadAttention, which calls no module
        targets = [
            name
            for name, module in model.named_modules()
            if isinstance(module, nn.Linear) and not isinstance(module, kinds)
        ]
        alpha = self.config.lora_alpha or min(rank, 16)
        lora = peft.LoraConfig(r=rank, lora_alpha=alpha, target_modules=targets)
        model.requires_grad_(False)
        peft.inject_adapter_in_model(lora, model)
        device = next(model.parameters()).device
        for name, parameter in model.named_parameters():
            if "lora_" in name:  # small steps are lost in bfloat16
                parameter.data = parameter.data.to(device, torch.float32)
                parameter.requires_grad_(True)
        if torch.amp.is_autocast_available(device.type):
            for module in model.modules():
                if hasattr(module, "lora_A"):  # the autocast does what peft would do by a copy in float32
                    module.cast_input_dtype_enabled = self._dtype == torch.float32

    def _token_id(self, text: str) -> int:
        number = self.tokenizer.token_to_id(text)
        if number is None:
            raise ValueError(
                f"the tokenizer has no token {text!r}, which {self.config.backbone['model_type']} puts around images: "
                "take the tokenizer of this backbone"
            )
        return int(number)

    def _prompt_ids(self, instruction: str) -> list[int]:
        if instruction not in self._prompts:
            text = self.config.prompt.replace("{instruction}", instruction.lower())
            self._prompts[instruction] = [
                *self.tokenizer.encode(text, add_special_tokens=False).ids,
                *self.config.prompt_end,
            ]
        return self._prompts[instruction]

    @torch.compiler.disable  # see Policy._goals
    def _prompt_tensors(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Ids and which of them are no padding, [n, L] each; L is that of the longest known prompt, or more."""
        ids, valid = _padded(tuple(tuple(self._prompt_ids(text)) for text in instructions), self._longest)
        device = self.state_low.device
        return ids.to(device), valid.to(device)


@functools.lru_cache(maxsize=64)
def _padded(rows: tuple[tuple[int, ...], ...], at_least: int) -> tuple[Tensor, Tensor]:
    length = max([at_least, *map(len, rows)])
    # In front, so that the prompt's last token stands before the placeholders in every row.
    ids = torch.tensor([[*[0] * (length - len(row)), *row] for row in rows], device="cpu")
    valid = torch.tensor([[False] * (length - len(row)) + [True] * len(row) for row in rows], device="cpu")
    return ids, valid
