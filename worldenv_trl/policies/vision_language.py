"""What every policy over a Hugging Face vision-language model shares: images, prompts, bounds, adapters, files."""

from __future__ import annotations

import abc
import functools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor, nn

from worldenv_trl.keys import CHUNK_LENGTH, STATE_DIM
from worldenv_trl.policies.adapters import check_adapters, inject_adapters
from worldenv_trl.policies.base import Policy, check_rank
from worldenv_trl.policies.hf_backbone import FAMILIES, backbone_config, make_model
from worldenv_trl.policies.images import prepare_images
from worldenv_trl.policies.proprio import libero_proprio
from worldenv_trl.pretrained import Pretrained, with_tuples

if TYPE_CHECKING:
    from tokenizers import Tokenizer
    from transformers import PreTrainedModel

    from worldenv_trl.policies.prismatic import PrismaticModel

__all__ = ["VisionLanguageConfig", "VisionLanguagePolicy"]

TOKENIZER_NAME = "tokenizer.json"
PROMPT = "In: What action should the robot take to {instruction}?\nOut:"
STATE_BINS = 256  # of a number of proprioception that is told in words


@dataclass(frozen=True)
class VisionLanguageConfig:
    """What a :class:`VisionLanguagePolicy` is made of, and trained for.

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
        prompt_end: ids of tokens behind every prompt.
        proprio_format: of the proprioception that the backbone is told, ``state``, the env's 7 numbers, or ``libero``,
            8 numbers: the gripper's opening becomes the positions of LIBERO's two fingers (m).
        fixed_statistics: keep the bounds of proprioception and actions that came with a checkpoint, which was trained
            with them: :meth:`VisionLanguagePolicy.fit_statistics` then changes nothing.
        lora_rank: of the adapters on every linear layer of the backbone; 0 is none, and all of it can learn.
        lora_alpha: their gain times the rank; at most 16 and no more than the rank when 0, as in OpenVLA-OFT.
        dtype: of the backbone's weights and products, ``float32`` or ``bfloat16``; what learns is float32.
        gradient_checkpointing: keep no activations inside the backbone's layers, compute them again.

    Raises:
        ValueError: for a size, a prompt or a family that cannot be built.
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
    prompt_end: tuple[int, ...] = ()
    proprio_format: str = "state"
    fixed_statistics: bool = False
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
        if self.proprio_format not in ("state", "libero"):
            raise ValueError(f"proprio_format must be 'state' or 'libero', got {self.proprio_format!r}")
        if self.dtype not in ("float32", "bfloat16"):
            raise ValueError(f"dtype must be 'float32' or 'bfloat16', got {self.dtype!r}")
        if "{instruction}" not in self.prompt:
            raise ValueError(f"prompt must hold {{instruction}}, got {self.prompt!r}")
        check_adapters(self.lora_rank, self.lora_alpha)

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Self:
        return cls(**with_tuples(fields))


class VisionLanguagePolicy(Policy, Pretrained):
    """Images, a prompt and a language model; what is read out of it is up to the subclass.

    A subclass makes ``self.backbone`` and its heads between :meth:`_make_model` and :meth:`_prepare_learning`, and
    implements :meth:`head_parameters`, :meth:`_set_action_bounds` and what :class:`Policy` asks for. Proprioception and
    actions are mapped to [-1, 1] by the 1 % and 99 % quantiles that :meth:`fit_statistics` takes from data.

    Args:
        config: its settings.
        tokenizer: of the backbone; saved beside the weights as ``tokenizer.json``.
    """

    companion_names: ClassVar[tuple[str, ...]] = (TOKENIZER_NAME,)
    resize = "lanczos"
    config: VisionLanguageConfig
    backbone: Any
    state_low: Tensor
    state_high: Tensor

    def __init__(self, config: VisionLanguageConfig, tokenizer: Tokenizer) -> None:
        super().__init__(
            cameras=config.cameras,
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            proprio=config.proprio,
            instructions=config.instructions,
        )
        self.config, self.tokenizer = config, tokenizer
        self._dtype = getattr(torch, config.dtype)
        self._proprio_dim = STATE_DIM + (config.proprio_format == "libero")
        self._prompts: dict[str, list[int]] = {}
        self._longest = 0

    @classmethod
    def from_backbone(cls, folder: str | os.PathLike, *, device: str | torch.device = "cpu", **settings: Any) -> Self:
        """A policy over a pretrained vision-language model; what it lacks for acting is untrained.

        Args:
            folder: what transformers' ``save_pretrained`` of model and processor wrote: ``config.json``, safetensors,
                ``tokenizer.json`` and, for mean and deviation of the images, ``preprocessor_config.json``; or
                ``owner/name`` of a repository of the Hub that holds these.

        Keyword Args:
            device: of the parameters; on ``meta`` no weights are read, only that their files are there is checked.
            settings: fields of the policy's config.

        Raises:
            FileNotFoundError: if one of these files is missing.
            ValueError: for a family that is not known, another kind of checkpoint (what reads it is said), or settings
                that cannot be.
        """
        from worldenv_trl.policies.hf_files import read_backbone

        fields, tokenizer, whole = read_backbone(folder, getattr(torch, settings.get("dtype", "float32")), device)
        policy = cls(cls.config_class(**(fields | settings)), tokenizer, whole.model)  # type: ignore[call-arg]
        policy.take_output_embeddings(whole.get_output_embeddings().weight)
        return policy.to(device)

    def take_output_embeddings(self, rows: Tensor) -> None:
        """What a pretrained model's language head is made of, [vocabulary, dim], for those who read tokens out."""

    @abc.abstractmethod
    def head_parameters(self) -> list[nn.Parameter]:
        """What learns in full beside the backbone."""

    @abc.abstractmethod
    def _set_action_bounds(self, center: Tensor, half: Tensor) -> None:
        """Takes middle and half range of the actions, [7] each."""

    # ------------------------------------------------------------------------------------------------- building

    def _make_model(self, model: PreTrainedModel | PrismaticModel | None) -> tuple[Any, dict[str, Any]]:
        """The model, with random weights when None, and what a backbone has to know of its tokens."""
        if model is None:
            model = make_model(backbone_config(self.config.backbone), self._dtype)
        family = FAMILIES[model.config.model_type]
        around = tuple(tuple(self._token_id(text) for text in texts) for texts in (family.before, family.after))
        first = self.tokenizer.encode("", add_special_tokens=True).ids  # what stands before every text
        return model, {"token_ids": (around[0], around[1]), "first_id": first[0] if first else None}

    def _prepare_learning(self) -> None:
        """Bounds, adapters and checkpoints, when all modules are there."""
        config = self.config
        self.register_buffer("state_low", -torch.ones(self._proprio_dim))
        self.register_buffer("state_high", torch.ones(self._proprio_dim))
        if "{state}" not in config.prompt:
            self._longest = max(map(len, map(self._prompt_ids, config.instructions)), default=0)
        if config.lora_rank:
            self._inject_adapters()
        if config.gradient_checkpointing:
            model = self.backbone.model
            # Its older name is deprecated since transformers 5.23.
            enable: Any = getattr(model, "activation_checkpointing_enable", None) or model.gradient_checkpointing_enable
            enable({"use_reentrant": False})
            model.disable_input_require_grads()  # for reentrant checkpoints alone

    def _inject_adapters(self) -> None:
        inject_adapters(self.backbone.model, self.config.lora_rank, self.config.lora_alpha, self._dtype)

    def _token_id(self, text: str) -> int:
        number = self.tokenizer.token_to_id(text)
        if number is None:
            raise ValueError(
                f"the tokenizer has no token {text!r}, which {self.config.backbone['model_type']} puts around images: "
                "take the tokenizer of this backbone"
            )
        return int(number)

    def companions(self) -> dict[str, bytes]:
        return {TOKENIZER_NAME: self.tokenizer.to_str().encode()}

    @classmethod
    def build(cls, config: Any, folder: Path) -> Self:
        from tokenizers import Tokenizer
        from transformers.initialization import no_init_weights

        with no_init_weights():  # billions of random numbers take minutes
            return cls(config, Tokenizer.from_file(str(folder / TOKENIZER_NAME)))

    # ------------------------------------------------------------------------------------------------- learning

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
        self._set_action_bounds(action_center, action_half)
        self.action_range.copy_(action_half)

    def post_training_parameters(self, rank: int) -> dict[str, list[nn.Parameter]]:
        """The adapters (peft) of the backbone's linear layers, and :meth:`head_parameters` in full; at rank 0 the
        backbone itself instead of adapters."""
        check_rank(rank, self.config.lora_rank)
        if rank and not self.config.lora_rank:
            self.config = replace(self.config, lora_rank=rank)
            self._inject_adapters()
        adapters = [each for name, each in self.backbone.named_parameters() if "lora_" in name]
        groups = {"adapters": adapters} if rank else {"backbone": list(self.backbone.parameters())}
        groups["heads"] = self.head_parameters()
        self.requires_grad_(False)
        for group in groups.values():
            for parameter in group:
                parameter.requires_grad_(True)
        return groups

    # ------------------------------------------------------------------------------------------------- what it sees

    def _pixels(self, images: Mapping[str, Tensor]) -> Tensor:
        """Prepared images of every camera, [n, cameras, 3, S, S]."""
        config = self.config
        return prepare_images(
            torch.stack([images[camera] for camera in self.cameras], 1),
            config.resolution,
            resize=self.resize,
            rotation=config.rotation,
            mirror=config.mirror,
            crop_area=config.crop_area,
            mean=config.image_mean,
            std=config.image_std,
        )

    def _proprio(self, state: Tensor) -> Tensor:
        return state if self.config.proprio_format == "state" else libero_proprio(state)

    def _normalized_proprio(self, state: Tensor) -> Tensor:
        span = self.state_high - self.state_low
        return (2 * (self._proprio(state) - self.state_low) / (span + 1e-8) - 1).clamp(-1, 1)

    def _prompt_ids(self, instruction: str, state: str = "") -> list[int]:
        known = self._prompts.get(instruction) if not state else None
        if known is not None:
            return known
        text = self.config.prompt.replace("{instruction}", self._worded(instruction)).replace("{state}", state)
        ids = [*self.tokenizer.encode(text, add_special_tokens=False).ids, *self.config.prompt_end]
        if not state:
            self._prompts[instruction] = ids
        return ids

    def _worded(self, instruction: str) -> str:
        """As it stands in the prompt."""
        return instruction.lower()

    def _state_bins(self, state: Tensor) -> list[list[int]]:
        """The numbers of proprioception [n, 7] as they stand in a prompt with ``{state}``."""
        bins = ((self._normalized_proprio(state) + 1) * (STATE_BINS / 2)).long().clamp(max=STATE_BINS - 1)
        return bins.tolist()

    @torch.compiler.disable  # see Policy._goals
    def _prompt_tensors(self, instructions: Sequence[str], state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Ids and which of them are no padding, [n, L] each; L is that of the longest known prompt, or more.

        Args:
            instructions: n texts.
            state: [n, 7], for a prompt with ``{state}``.
        """
        told = [""] * len(instructions)
        if state is not None and "{state}" in self.config.prompt:
            told = [" ".join(map(str, row)) for row in self._state_bins(state)]
        rows = tuple(tuple(self._prompt_ids(text, seen)) for text, seen in zip(instructions, told, strict=True))
        ids, valid = _padded(rows, self._longest)
        device = self.state_low.device
        return ids.to(device), valid.to(device)


@functools.lru_cache(maxsize=64)
def _padded(rows: tuple[tuple[int, ...], ...], at_least: int) -> tuple[Tensor, Tensor]:
    length = max([at_least, *map(len, rows)])
    # In front, so that the prompt's last token stands before the placeholders in every row.
    ids = torch.tensor([[*[0] * (length - len(row)), *row] for row in rows], device="cpu")
    valid = torch.tensor([[False] * (length - len(row)) + [True] * len(row) for row in rows], device="cpu")
    return ids, valid
