"""The backbone of OpenVLA and OpenVLA-OFT: DINOv2 and SigLIP side by side, a projector and Llama-2.

Parameters are named as in the released checkpoints, whose vision towers were written with timm; timm itself is not
needed. The last block of each tower and SigLIP's pooling are left out: features are read one block earlier.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worldenv_trl.pretrained import with_tuples

if TYPE_CHECKING:
    from transformers import PreTrainedConfig

__all__ = ["PrismaticConfig", "PrismaticModel", "TowerConfig"]


@dataclass(frozen=True)
class TowerConfig:
    """One vision transformer.

    Args:
        dim, depth, num_heads, mlp_dim: its sizes; ``depth`` counts the blocks that are used.
        patch_size: side of a patch (px).
        registers: tokens beside the class token, DINOv2's.
        class_token: whether there is one.
        layer_scale: whether each block's additions have a learned gain.
        mean, std: of each channel of the images it was pretrained on, values in [0, 1].
    """

    dim: int
    depth: int
    num_heads: int
    mlp_dim: int
    patch_size: int = 14
    registers: int = 0
    class_token: bool = False
    layer_scale: bool = False
    mean: tuple[float, ...] = (0.5, 0.5, 0.5)
    std: tuple[float, ...] = (0.5, 0.5, 0.5)


class PrismaticConfig:
    """What a :class:`PrismaticModel` is built from.

    Args:
        text_config: of the language model, as transformers has it: ``{"model_type": "llama", ...}``.
        vision_config: ``image_size`` (px) and ``towers``, the fields of one :class:`TowerConfig` each.
    """

    model_type = "prismatic"

    def __init__(self, text_config: Mapping[str, Any], vision_config: Mapping[str, Any]) -> None:
        from transformers import AutoConfig

        text = dict(text_config)
        self.text_config: PreTrainedConfig = AutoConfig.for_model(text.pop("model_type", "llama"), **text)
        self.image_size = int(vision_config["image_size"])
        self.towers = tuple(_tower(tower) for tower in vision_config["towers"])

    def get_text_config(self) -> PreTrainedConfig:
        return self.text_config

    def to_dict(self) -> dict[str, Any]:
        towers = [asdict(tower) for tower in self.towers]
        return {
            "model_type": self.model_type,
            "text_config": self.text_config.to_dict(),
            "vision_config": {"image_size": self.image_size, "towers": towers},
        }

    def __deepcopy__(self, memo: dict) -> PrismaticConfig:
        fields = copy.deepcopy(self.to_dict())
        return PrismaticConfig(fields["text_config"], fields["vision_config"])


def _tower(fields: Mapping[str, Any]) -> TowerConfig:
    return TowerConfig(**with_tuples(fields))


class _Gain(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale_factor


class _Attention(nn.Module):
    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv, self.proj = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        query, key, value = self.qkv(x).unflatten(-1, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2))


class _MLP(nn.Module):
    def __init__(self, dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(dim, hidden_dim), nn.Linear(hidden_dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class VisionEncoderLayer(nn.Module):
    """Pre-norm block of a tower."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        dim = config.dim
        self.norm1, self.norm2 = nn.LayerNorm(dim, eps=1e-6), nn.LayerNorm(dim, eps=1e-6)
        self.attn, self.mlp = _Attention(dim, config.num_heads), _MLP(dim, config.mlp_dim)
        self.ls1, self.ls2 = (_Gain(dim) if config.layer_scale else nn.Identity() for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class VisionTower(nn.Module):
    """Patch features of images [n, 3, S, S] with values in [0, 1]: [n, P, dim]."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: TowerConfig, image_size: int) -> None:
        super().__init__()
        dim = config.dim
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, dim, config.patch_size, stride=config.patch_size)})
        self.pos_embed = nn.Parameter(torch.randn(1, (image_size // config.patch_size) ** 2, dim) * 0.02)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim)) if config.class_token else None
        self.reg_token = nn.Parameter(torch.zeros(1, config.registers, dim)) if config.registers else None
        self.blocks = nn.ModuleList(VisionEncoderLayer(config) for _ in range(config.depth))
        for name, values in (("mean", config.mean), ("std", config.std)):
            self.register_buffer(name, torch.tensor(values).reshape(-1, 1, 1), persistent=False)
        self.checkpoint: Callable[..., Tensor] | None = None

    def forward(self, images: Tensor) -> Tensor:
        pixels = (images - self.mean) / self.std
        x = self.patch_embed["proj"](pixels.to(self.pos_embed.dtype)).flatten(2).mT + self.pos_embed
        extra = [each.expand(x.shape[0], -1, -1) for each in (self.cls_token, self.reg_token) if each is not None]
        x = torch.cat([*extra, x], 1)
        for block in self.blocks:
            x = block(x) if self.checkpoint is None else self.checkpoint(block, x)
        return x[:, sum(each.shape[1] for each in extra) :]


class _Projector(nn.Module):
    def __init__(self, vision_dim: int, dim: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(vision_dim, 4 * vision_dim), nn.Linear(4 * vision_dim, dim)
        self.fc3 = nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc3(F.gelu(self.fc2(F.gelu(self.fc1(x)))))


class PrismaticModel(nn.Module):
    """The backbone, without its language-modelling head, as :class:`VisionLanguageBackbone` takes it.

    Args:
        config: its sizes.
        dtype: of the weights.
    """

    def __init__(self, config: PrismaticConfig, dtype: torch.dtype) -> None:
        super().__init__()
        from transformers import AutoModel

        self.config = config
        self.towers = nn.ModuleList(VisionTower(tower, config.image_size) for tower in config.towers)
        dim = config.text_config.hidden_size
        self.projector = _Projector(sum(tower.dim for tower in config.towers), dim)
        for module in (self.towers, self.projector):
            module.to(dtype)
        self.language_model = AutoModel.from_config(config.text_config, dtype=dtype)

    @property
    def dtype(self) -> torch.dtype:
        return self.projector.fc1.weight.dtype

    def get_image_features(self, images: Tensor) -> Tensor:
        """What the language model sees of images [n, 3, S, S] with values in [0, 1]: [n, P, dim]."""
        return self.projector(torch.cat([tower(images) for tower in self.towers], -1))

    def activation_checkpointing_enable(self, settings: Mapping[str, Any]) -> None:
        from torch.utils.checkpoint import checkpoint

        language = self.language_model
        enable = getattr(language, "activation_checkpointing_enable", None) or language.gradient_checkpointing_enable
        enable(dict(settings))
        towers: list[Any] = list(self.towers)
        for tower in towers:
            tower.checkpoint = partial(checkpoint, **settings)

    def disable_input_require_grads(self) -> None:
        self.language_model.disable_input_require_grads()


def dinosiglip_towers() -> Sequence[TowerConfig]:
    """The towers of ``dinosiglip-vit-so-224px``, in the order of their features."""
    dino = TowerConfig(
        dim=1024,
        depth=23,
        num_heads=16,
        mlp_dim=4096,
        registers=4,
        class_token=True,
        layer_scale=True,
        mean=(0.485, 0.456, 0.406),
        std=(0.229, 0.224, 0.225),
    )
    return dino, TowerConfig(dim=1152, depth=26, num_heads=16, mlp_dim=4304)
