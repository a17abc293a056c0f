"""Flow-matching policies, SmolVLA, pi0 and pi0.5, with a Laplace scale around what their flow ends in."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor, nn

from worldenv_trl.keys import ACTION_DIM, CHUNK_LENGTH, STATE_DIM
from worldenv_trl.policies.adapters import check_adapters, inject_adapters
from worldenv_trl.policies.base import Policy, check_rank
from worldenv_trl.policies.flow_network import FLOW_FAMILIES, FlowNetwork
from worldenv_trl.policies.flow_prompts import Prompts
from worldenv_trl.policies.heads import MLPResNet
from worldenv_trl.policies.hf_backbone import FAMILIES, autocast, backbone_config, make_model
from worldenv_trl.policies.images import bilinear_resize
from worldenv_trl.policies.proprio import libero_proprio
from worldenv_trl.pretrained import Pretrained, with_tuples

if TYPE_CHECKING:
    from tokenizers import Tokenizer

__all__ = ["FlowConfig", "FlowPolicy", "make_network"]

TOKENIZER_NAME = "tokenizer.json"


@dataclass(frozen=True)
class FlowConfig:
    """What a :class:`FlowPolicy` is made of, and trained for.

    Args:
        kind: of :data:`~worldenv_trl.policies.flow_network.FLOW_FAMILIES`: ``smolvla``, ``pi0`` or ``pi05``.
        backbone: ``to_dict()`` of the transformers config of the vision-language model, with the layers that are used.
        expert: ``hidden_size``, ``intermediate_size`` and ``num_hidden_layers`` of the action expert.
        instructions: those it is trained on; others are answered with a warning. Empty: it never warns.
        cameras: scene cameras it looks through, in the order of training.
        image_size: height and width of the env's images (px).
        chunk_length: actions of a decision, the first of what the flow ends in.
        proprio: what the state tells, ``commanded`` or ``measured``.
        horizon: actions that the flow makes at once.
        num_steps: Euler steps from noise to actions.
        noise_seed: of the noise that every flow begins with.
        resolution: side of the images that the backbone sees (px).
        mirror: swap left and right of the env's images first. LIBERO's data sets hold mirrored ones.
        image_tokens: put the family's special tokens around images.
        max_tokens: of a text; what is longer is cut.
        proprio_format: ``state``, the env's 7 numbers, or ``libero``, 8: the gripper's opening becomes the positions
            of LIBERO's two fingers (m).
        max_state_dim, max_action_dim: to which proprioception and actions are padded.
        self_every: of the expert's layers, see :class:`~worldenv_trl.policies.flow_network.Expert`.
        min_period, max_period: of the sinusoids of the flow's time.
        normalization: what :meth:`FlowPolicy.fit_statistics` takes from data, ``mean_std`` or ``quantiles``.
        fixed_statistics: keep those that came with a checkpoint: :meth:`FlowPolicy.fit_statistics` changes nothing.
        head_dim: width of the scale head; that of the expert when 0.
        head_blocks: its residual blocks.
        log_scale_init: the log-scale before training.
        lora_rank: of the adapters on every linear layer of both towers; 0 is none, and all of them can learn.
        lora_alpha: their gain times the rank; at most 16 and no more than the rank when 0.
        dtype: of the towers' weights and products, ``float32`` or ``bfloat16``; what learns beside them is float32.
        gradient_checkpointing: keep no activations inside layers and steps of the flow, compute them again.

    Raises:
        ValueError: for a kind, a size or a setting that cannot be built.
    """

    kind: str
    backbone: Mapping[str, Any] = field(repr=False)
    expert: Mapping[str, int]
    instructions: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ("agentview", "wrist")
    image_size: int = 256
    chunk_length: int = CHUNK_LENGTH
    proprio: str = "measured"
    horizon: int = 50
    num_steps: int = 10
    noise_seed: int = 0
    resolution: int = 224
    mirror: bool = False
    image_tokens: bool = False
    max_tokens: int = 48
    proprio_format: str = "libero"
    max_state_dim: int = 32
    max_action_dim: int = 32
    self_every: int = 0
    min_period: float = 4e-3
    max_period: float = 4.0
    normalization: str = "mean_std"
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
        object.__setattr__(self, "expert", dict(self.expert))
        for name, known in (
            ("kind", tuple(FLOW_FAMILIES)),
            ("proprio_format", ("state", "libero")),
            ("normalization", ("mean_std", "quantiles")),
            ("dtype", ("float32", "bfloat16")),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        wanted, found = FLOW_FAMILIES[self.kind].backbone, self.backbone.get("model_type")
        if found != wanted:
            raise ValueError(f"the backbone of {self.kind} must be a {wanted}, got {found!r}")
        if not 1 <= self.chunk_length <= self.horizon:
            raise ValueError(
                f"chunk_length must be at least 1 and at most {self.horizon}, the actions that this flow makes at "
                f"once, got {self.chunk_length}"
            )
        if self.num_steps < 1 or self.max_tokens < 1:
            raise ValueError(f"num_steps and max_tokens must be at least 1, got {self.num_steps}, {self.max_tokens}")
        if self.max_action_dim < ACTION_DIM or self.max_state_dim < self.proprio_dim:
            raise ValueError(
                f"max_action_dim must be at least {ACTION_DIM} and max_state_dim {self.proprio_dim}, got "
                f"{self.max_action_dim} and {self.max_state_dim}"
            )
        check_adapters(self.lora_rank, self.lora_alpha)

    @property
    def proprio_dim(self) -> int:
        """Numbers of proprioception before they are padded."""
        return STATE_DIM + (self.proprio_format == "libero")

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Self:
        return cls(**with_tuples(fields))


class FlowPolicy(Policy, Pretrained):
    """Maps images, proprioception and the instruction to the Laplace parameters of an action chunk.

    ``loc`` is where the flow of SmolVLA (arXiv:2506.01844), pi0 (arXiv:2410.24164) or pi0.5 (arXiv:2504.16054) ends
    when it is integrated by Euler's method from one fixed noise, the same in every decision: a function of the
    observation alone, with gradients through all of the integration. A flow has no density that can be computed
    cheaply, which policy gradients need. ReinFlow (arXiv:2505.22094) and pi_RL (arXiv:2510.25889) learn or inject
    noise at each step of the integration and score the whole path; here it is put around the flow's end, as
    World-Env does around a regressed action: a head reads the expert's hidden states of the last step and gives
    ``log_scale``, trained by the Laplace likelihood (World-Env Eq. 8), and the density of a chunk is exact. Noise other
    than the fixed one, and with it what is multimodal in the flow, is not explored.

    Args:
        config: its settings.
        tokenizer: of the backbone; saved beside the weights as ``tokenizer.json``.
        network: with random weights when None. :func:`~worldenv_trl.policies.load_lerobot` reads pretrained ones.

    Raises:
        ValueError: if the tokenizer lacks a token that the family needs.
    """

    config_class = FlowConfig
    companion_names = (TOKENIZER_NAME,)
    config: FlowConfig
    noise: Tensor
    action_center: Tensor
    action_gain: Tensor
    state_center: Tensor
    state_gain: Tensor

    def __init__(self, config: FlowConfig, tokenizer: Tokenizer, network: FlowNetwork | None = None) -> None:
        super().__init__(
            cameras=config.cameras,
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            proprio=config.proprio,
            instructions=config.instructions,
        )
        self.config = config
        self._dtype = getattr(torch, config.dtype)
        self.prompts = Prompts(config.kind, tokenizer, config.max_tokens)
        self.network = make_network(config, tokenizer) if network is None else network
        width = self.network.expert.width
        self.scale_head = MLPResNet(
            width,
            config.head_dim or width,
            ACTION_DIM,
            config.head_blocks,
            out_bias=config.log_scale_init,
            out_gain=0.01,
        )
        generator = torch.Generator(device="cpu").manual_seed(config.noise_seed)
        noise = torch.randn(config.horizon, config.max_action_dim, generator=generator, device="cpu")
        self.register_buffer("noise", noise)
        self.register_buffer("state_center", torch.zeros(config.proprio_dim))
        self.register_buffer("state_gain", torch.ones(config.proprio_dim))
        self.register_buffer("action_center", torch.zeros(ACTION_DIM))
        self.register_buffer("action_gain", torch.ones(ACTION_DIM))
        if config.lora_rank:
            self._inject_adapters()

    def predict(
        self, images: Mapping[str, Tensor], state: Tensor, instructions: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        config, network = self.config, self.network
        pixels = torch.stack([images[camera] for camera in self.cameras], 1)  # [n, cameras, 3, H, W]
        pixels = bilinear_resize(pixels.flip(-1) if config.mirror else pixels, config.resolution)
        proprio = (self._proprio(state) - self.state_center) / self.state_gain
        ids, valid = self.prompts(instructions, proprio)
        padded = nn.functional.pad(proprio, (0, config.max_state_dim - proprio.shape[-1]))
        actions = self.noise.expand(state.shape[0], -1, -1)
        with autocast(state.device, self._dtype):
            prefix = network.prefix(2 * pixels - 1, ids, valid, padded)
        for step in range(config.num_steps):
            with autocast(state.device, self._dtype):
                hidden = network.hidden(prefix, padded, actions, 1 - step / config.num_steps)
            actions = actions - network.velocity(hidden) / config.num_steps
        loc = actions[:, : self.chunk_length, :ACTION_DIM] * self.action_gain + self.action_center
        return loc, self.scale_head(hidden[:, : self.chunk_length].float())

    @torch.no_grad()
    def fit_statistics(self, states: Tensor, actions: Tensor) -> None:
        """Takes normalisation from data, [..., 7] each: mean and deviation, or the 1 % and 99 % quantiles.

        The gain of an action is at least .005, and of a state .05. Nothing changes with ``fixed_statistics``.

        Raises:
            ValueError: for no data, or numbers that are not finite.
        """
        found = []
        for name, values, floor in (("states", self._proprio(states), 0.05), ("actions", actions, 0.005)):
            flat = values.reshape(-1, values.shape[-1]).float()
            if flat.shape[0] == 0 or not torch.isfinite(flat).all():
                raise ValueError(f"{name} must hold at least one row and only finite numbers")
            low, high = torch.quantile(flat, torch.tensor([0.01, 0.99]).to(flat), dim=0)
            center, gain = (low + high) / 2, (high - low) / 2
            if self.config.normalization == "mean_std":
                center, gain = flat.mean(0), flat.std(0, correction=0)
            found.append((center, gain.clamp(min=floor), ((high - low) / 2).clamp(min=floor)))
        if self.config.fixed_statistics:
            return
        (state_center, state_gain, _), (action_center, action_gain, action_range) = found
        self.state_center.copy_(state_center)
        self.state_gain.copy_(state_gain)
        self.action_center.copy_(action_center)
        self.action_gain.copy_(action_gain)
        self.action_range.copy_(action_range)

    def scale_parameters(self) -> list[nn.Parameter]:
        return list(self.scale_head.parameters())

    def post_training_parameters(self, rank: int) -> dict[str, list[nn.Parameter]]:
        """The adapters (peft) of both towers' linear layers, and in full the projections of proprioception, actions
        and time and the scale head; at rank 0 the towers themselves instead of adapters."""
        check_rank(rank, self.config.lora_rank)
        if rank and not self.config.lora_rank:
            self.config = dataclasses.replace(self.config, lora_rank=rank)
            self._inject_adapters()
        towers = [each for tower in self.network.towers() for each in tower.named_parameters()]
        groups = {"adapters": [each for name, each in towers if "lora_" in name]}
        if not rank:
            groups = {"backbone": [each for _, each in towers]}
        groups["heads"] = [*self.network.projections(), *self.scale_head.parameters()]
        self.requires_grad_(False)
        for parameter in itertools.chain(*groups.values()):
            parameter.requires_grad_(True)
        return groups

    def companions(self) -> dict[str, bytes]:
        return {TOKENIZER_NAME: self.prompts.tokenizer.to_str().encode()}

    @classmethod
    def build(cls, config: FlowConfig, folder: Path) -> Self:
        from tokenizers import Tokenizer
        from transformers.initialization import no_init_weights

        with no_init_weights():  # billions of random numbers take minutes
            return cls(config, Tokenizer.from_file(str(folder / TOKENIZER_NAME)))

    def _proprio(self, state: Tensor) -> Tensor:
        return state if self.config.proprio_format == "state" else libero_proprio(state)

    def _inject_adapters(self) -> None:
        for tower in self.network.towers():
            inject_adapters(tower, self.config.lora_rank, self.config.lora_alpha, self._dtype)


def make_network(config: FlowConfig, tokenizer: Tokenizer) -> FlowNetwork:
    """The network of a config, with random weights, on torch's default device.

    Raises:
        ValueError: if the tokenizer lacks a token that the family needs.
    """
    family, dtype = FLOW_FAMILIES[config.kind], getattr(torch, config.dtype)
    model = make_model(backbone_config(config.backbone), dtype)
    around: tuple[list[int], ...] = ([], [])
    if config.image_tokens:
        texts = FAMILIES[family.backbone]
        around = tuple([_token_id(tokenizer, text) for text in each] for each in (texts.before, texts.after))
    network = FlowNetwork(
        family,
        model,
        config.expert,
        token_ids=(around[0], around[1]),
        max_state_dim=config.max_state_dim,
        max_action_dim=config.max_action_dim,
        self_every=config.self_every,
        periods=(config.min_period, config.max_period),
        checkpointing=config.gradient_checkpointing,
    )
    network.expert.to(dtype)
    if config.gradient_checkpointing:
        # Its older name is deprecated since transformers 5.23.
        enable: Any = getattr(model, "activation_checkpointing_enable", None) or model.gradient_checkpointing_enable
        enable({"use_reentrant": False})
        model.disable_input_require_grads()  # for reentrant checkpoints alone
    return network


def _token_id(tokenizer: Tokenizer, text: str) -> int:
    number = tokenizer.token_to_id(text)
    if number is None:
        raise ValueError(f"the tokenizer has no token {text!r}: take the tokenizer of this backbone")
    return int(number)
