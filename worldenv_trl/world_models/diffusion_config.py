"""Sizes and settings of the full-size world model: EnerVerse-AC's, on classes of diffusers and transformers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from worldenv_trl.kinematics.calibrations import plain_cameras
from worldenv_trl.robot.camera import Camera

__all__ = ["CONDITION_CHANNELS", "DiffusionWorldModelConfig"]

CONDITION_CHANNELS = (
    7  # beside the latents of noise, image and action map: the memory's mask, a ray's origin, direction
)

_MOST_SEQUENCES = 65_535  # that a GPU's attention kernel takes at once: every cell has one over time
_BLOCKS = 3
_VAE = {  # Stable Diffusion's: 8 x 8 pixels to one of 4 channels
    "in_channels": 3,
    "out_channels": 3,
    "latent_channels": 4,
    "block_out_channels": (128, 256, 512, 512),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 2,
    "scaling_factor": 0.18215,
}
_UNET = {  # Stable Video Diffusion's, which has EVAC's channels, multipliers and attention at strides 4, 2 and 1
    "block_out_channels": (320, 640, 1280, 1280),
    "layers_per_block": 2,
    "num_attention_heads": (5, 10, 20, 20),
    "cross_attention_dim": 1024,
    "down_block_types": ("CrossAttnDownBlockSpatioTemporal",) * _BLOCKS + ("DownBlockSpatioTemporal",),
    "up_block_types": ("UpBlockSpatioTemporal",) + ("CrossAttnUpBlockSpatioTemporal",) * _BLOCKS,
}
_IMAGE_ENCODER = {  # OpenCLIP's ViT-H-14
    "model_type": "clip_vision_model",
    "hidden_size": 1280,
    "intermediate_size": 5120,
    "num_hidden_layers": 32,
    "num_attention_heads": 16,
    "image_size": 224,
    "patch_size": 14,
    "hidden_act": "gelu",
}


@dataclass(frozen=True)
class DiffusionWorldModelConfig:
    """Of a :class:`DiffusionWorldModel`; the defaults are EVAC's. Plain values: it is written to ``config.json``.

    Raises:
        ValueError: for sizes that do not fit each other, or settings out of range.
    """

    cameras: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """Camera name -> instruction -> the :class:`~worldenv_trl.robot.camera.Camera` it is; see :meth:`for_cameras`."""
    image_size: int = 256
    """Side of the frames (px) that come and go, square as everywhere."""
    frame_size: tuple[int, int] = (320, 512)
    """Height and width (px) of the frames inside; they are resized to it, action maps and rays alike."""
    chunk_length: int = 16
    memory_frames: int = 4
    """The first frame, those at equal parts of the video so far, and the last."""
    vae: dict[str, Any] = field(default_factory=lambda: dict(_VAE))
    """Of diffusers' ``AutoencoderKL``."""
    unet: dict[str, Any] = field(default_factory=lambda: dict(_UNET))
    """Of diffusers' ``UNetSpatioTemporalConditionModel``; its in and out channels follow from the VAE's."""
    image_encoder: dict[str, Any] = field(default_factory=lambda: dict(_IMAGE_ENCODER))
    """Of a vision tower of transformers, by its ``model_type``: ``clip_vision_model`` or ``siglip_vision_model``."""
    context_queries: int = 16
    """Tokens of image and of actions, each, that a frame is told."""
    resampler_depth: int = 4
    resampler_heads: int = 12
    resampler_head_dim: int = 64
    num_denoise_steps: int = 27
    """Of DDIM; 1 to 4 for a model that was trained or distilled to few."""
    eta: float = 1.0
    """0 adds no noise between steps, 1 as much as DDPM."""
    consistency_steps: int | None = None
    """In training, the network learns to jump to the clean end from each of so many noise levels (consistency training)
    instead of v; 1 to 4 denoising steps then paint. Begin with a network that has learned v. None learns v."""
    memory_noise: float = 0.1
    """In training, remembered latents are disturbed by up to this standard deviation, which the network is told."""
    precision: str = "auto"
    """``float32``, ``bfloat16`` (autocast) or ``auto``: bfloat16 on a GPU."""
    rows_per_call: int | None = None
    """Rows that are painted at once; None is 1 on a CPU and up to 8 on a GPU."""
    frames_per_call: int = 16
    """Frames that pass through the VAE at once."""
    gradient_checkpointing: bool = False
    """In training, activations of the UNet's blocks are computed twice instead of being kept."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame_size", tuple(int(side) for side in self.frame_size))
        height, width = self.frame_size
        scale, grid = self.latent_scale, self.latent_scale * 2 ** (len(self.unet["block_out_channels"]) - 1)
        views = max(1, len(self.cameras))
        if min(height, width) < 16 or height % scale or width % grid or (views * height) % grid:
            raise ValueError(
                f"frame_size must be at least 16 px, its width and the height of {views} views multiples of {grid} and "
                f"its height of {scale} (the strides of UNet and VAE), got {height} x {width}"
            )
        if min(self.image_size, 16) < 16:
            raise ValueError(f"image_size must be at least 16 px, got {self.image_size}")
        if self.memory_frames < 2:
            raise ValueError(f"memory_frames must be at least 2, the first and the last, got {self.memory_frames}")
        least = min(self.chunk_length, self.context_queries, self.resampler_depth, self.frames_per_call)
        if least < 1 or (self.rows_per_call is not None and self.rows_per_call < 1):
            raise ValueError(
                "chunk_length, context_queries, resampler_depth, frames_per_call and rows_per_call must be at least 1"
            )
        if not 1 <= self.num_denoise_steps <= 1000:
            raise ValueError(f"num_denoise_steps must lie between 1 and 1000, got {self.num_denoise_steps}")
        if self.consistency_steps is not None and not 2 <= self.consistency_steps <= 1000:
            raise ValueError(f"consistency_steps must lie between 2 and 1000, got {self.consistency_steps}")
        if not 0 <= self.eta <= 1 or self.memory_noise < 0:
            raise ValueError(
                f"eta must lie in [0, 1] and memory_noise not below 0, got {self.eta}, {self.memory_noise}"
            )
        if self.precision not in ("auto", "float32", "bfloat16"):
            raise ValueError(f"precision must be auto, float32 or bfloat16, got {self.precision!r}")

    @property
    def latent_scale(self) -> int:
        """Pixels per cell of the latents."""
        return 2 ** (len(self.vae["block_out_channels"]) - 1)

    @property
    def latent_size(self) -> tuple[int, int]:
        """Height and width of one view's latents."""
        return self.frame_size[0] // self.latent_scale, self.frame_size[1] // self.latent_scale

    def rows_at_once(self, device: torch.device) -> int:
        """:attr:`rows_per_call`, or what it is on ``device`` when that is None."""
        if self.rows_per_call is not None:
            return self.rows_per_call
        if device.type == "cpu":
            return 1
        height, width = self.latent_size
        return max(1, min(8, _MOST_SEQUENCES // (max(1, len(self.cameras)) * height * width)))

    @property
    def frames(self) -> int:
        """Remembered and painted: what the UNet sees."""
        return self.memory_frames + self.chunk_length

    @property
    def instructions(self) -> tuple[str, ...]:
        """Those that it has cameras for."""
        return tuple(next(iter(self.cameras.values()), {}))

    @classmethod
    def for_cameras(cls, cameras: Mapping[str, Mapping[str, Camera]], **settings: Any) -> DiffusionWorldModelConfig:
        """Config for ``{camera name: {instruction: camera}}``: what each instruction's scene is seen through."""
        return cls(cameras=plain_cameras(cameras), **settings)

    @staticmethod
    def sizes_of(folder: str | Path) -> dict[str, Any]:
        """``vae``, ``unet`` and ``image_encoder`` of a local folder in the layout of diffusers, those that it has.

        Raises:
            FileNotFoundError: if it has none of them.
            ValueError: for a VAE or a UNet of another class.
        """
        folder, found = Path(folder), {}
        for part, classes in _CLASSES.items():
            path = folder / part / "config.json"
            if path.exists():
                known = json.loads(path.read_text())
                name = known.get("_class_name") or next(iter(known.get("architectures") or [None]))
                if name not in classes:
                    raise ValueError(f"{path} describes a {name}, needed is a {' or '.join(classes)}{_REMEDY[part]}")
                found[part] = {key: value for key, value in known.items() if not key.startswith("_")}
        if not found:
            raise FileNotFoundError(
                f"no vae, unet or image_encoder in {folder}: name a folder in the layout of diffusers, such as "
                "one that DiffusionPipeline.save_pretrained wrote"
            )
        return found


_CLASSES = {
    "vae": ("AutoencoderKL",),
    "unet": ("UNetSpatioTemporalConditionModel",),
    "image_encoder": ("CLIPVisionModel", "CLIPVisionModelWithProjection", "SiglipVisionModel"),
}
_REMEDY = {
    "vae": "; Stable Video Diffusion's latents are also those of Stable Diffusion 2.1's VAE",
    "unet": "",
    "image_encoder": "",
}
