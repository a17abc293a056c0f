"""What the full-size world model is told beside remembered frames: action maps, rays, tokens of image and actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worldenv_trl.kinematics import ActionMap
from worldenv_trl.kinematics.calibrations import Calibrations
from worldenv_trl.world_models.base import PADDED_ACTION_DIM
from worldenv_trl.world_models.diffusion_config import DiffusionWorldModelConfig

__all__ = ["ContextTokens", "ViewGeometry"]

_BACKGROUND = 50 / 255  # EVAC's canvas is dark grey
# Disc, the tool's three axes, fingertips, drop shadow: red, green and blue of what ActionMap draws.
_COLOURS = ((0.8, 0.8, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.8, 0.0, 0.8), (0.0, 0.6, 0.6))
_COLOUR_STATISTICS = {
    "clip": ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
    "siglip": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
}


class ViewGeometry(nn.Module):
    """Where the hand and the rays are on one camera's image.

    Args:
        calibrations: of the camera.
        frame_size, latent_size: height and width of frames (px) and of their latents.
    """

    def __init__(self, calibrations: Calibrations, frame_size: tuple[int, int], latent_size: tuple[int, int]) -> None:
        super().__init__()
        self.calibrations, self.frame_size, self.latent_size = calibrations, frame_size, latent_size
        self.action_map = ActionMap(calibrations.distinct, max(16, frame_size[0]))
        self.register_buffer("_colours", torch.tensor(_COLOURS), persistent=False)

    def maps(self, poses: Tensor, newest: int, texts: Sequence[str]) -> Tensor:
        """Action maps as images [B, F, 3, H, W] in [-1, 1], for the VAE.

        Args:
            poses: [B, F, 13], of remembered frames and the chunk.
            newest: number of the last remembered one: a camera on the hand saw the hand from there.
            texts: B instructions.
        """
        which = self.calibrations.indices(texts)
        seen_from = poses[:, newest : newest + 1].expand_as(poses) if self.calibrations.any_mounted else None
        drawn = self.action_map(poses, which, seen_from)  # [B, F, 6, S, S]
        colours = torch.einsum("bfchw,cd->bfdhw", drawn, self.get_buffer("_colours"))
        images = (_BACKGROUND + colours).clamp(0, 1).flatten(0, 1) * 2 - 1
        return resized(images, self.frame_size).unflatten(0, poses.shape[:2])

    def rays(self, poses: Tensor, texts: Sequence[str]) -> Tensor:
        """Origin (m) and direction of each latent cell's ray, [B, F, 6, h, w]; a camera on the hand moves with it."""
        return self.action_map.rays(poses, self.latent_size, self.calibrations.indices(texts))


class ContextTokens(nn.Module):
    """What each frame cross-attends to: tokens of what is seen now, and of the chunk's actions.

    A frozen vision tower (CLIP or SigLIP) looks at the newest frame of each camera; a resampler of learned queries,
    some for each frame, reads its tokens (IP-Adapter's, EVAC's), another one the actions.
    """

    def __init__(self, config: DiffusionWorldModelConfig) -> None:
        from diffusers.models.embeddings import IPAdapterPlusImageProjection
        from transformers import AutoConfig, AutoModel

        super().__init__()
        sizes = dict(config.image_encoder)
        self.encoder: Any = AutoModel.from_config(AutoConfig.for_model(sizes.pop("model_type"), **sizes))
        self.encoder.eval().requires_grad_(False)
        width, seen = config.unet["cross_attention_dim"], self.encoder.config
        self.frames, self.queries = config.frames, config.context_queries
        shape = {
            "output_dims": width,
            "hidden_dims": width,
            "depth": config.resampler_depth,
            "heads": config.resampler_heads,
            "dim_head": config.resampler_head_dim,
            "num_queries": self.queries * self.frames,
        }
        self.image_resampler = IPAdapterPlusImageProjection(embed_dims=seen.hidden_size, **shape)
        self.action_in = nn.Linear(PADDED_ACTION_DIM, width)
        self.action_place = nn.Parameter(0.02 * torch.randn(config.chunk_length, width))
        self.action_resampler = IPAdapterPlusImageProjection(embed_dims=width, **shape)
        self._statistics = _COLOUR_STATISTICS["clip" if seen.model_type.startswith("clip") else "siglip"]

    def forward(self, newest: Tensor, actions: Tensor) -> Tensor:
        """Context [B, F, 2 Q, D] of the newest frames [B, V, 3, H, W] in [-1, 1] and actions [B, C, 14]."""
        batch, dtype = len(actions), self.action_in.weight.dtype
        seen = self.see(newest.flatten(0, 1)).unflatten(0, (batch, -1)).flatten(1, 2)  # [B, V tokens, D]
        image = self.image_resampler(seen.to(dtype))
        action = self.action_resampler(self.action_in(actions.to(dtype)) + self.action_place)
        return torch.cat([tokens.unflatten(1, (self.frames, -1)) for tokens in (image, action)], 2)

    @torch.no_grad()
    def see(self, images: Tensor) -> Tensor:
        """Tokens [n, L, D] of the frozen tower, of images [n, 3, H, W] in [-1, 1]."""
        size = self.encoder.config.image_size
        mean, std = (images.new_tensor(values).view(3, 1, 1) for values in self._statistics)
        pixels = ((resized(images, (size, size)) + 1) / 2 - mean) / std
        return self.encoder(pixel_values=pixels.to(self.encoder.dtype)).last_hidden_state


def resized(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Images [n, 3, *, *] as [n, 3, *size]; smaller ones are not aliased."""
    if tuple(images.shape[-2:]) == tuple(size):
        return images
    return F.interpolate(images, size, mode="bilinear", antialias=True, align_corners=False)
