"""The full-size world model: EnerVerse-AC's conditions on a video diffusion model of diffusers' parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from worldenv_trl.keys import CONTROL_HZ, NOISE_SEED, POSE_DIM, frames_key
from worldenv_trl.kinematics.calibrations import Calibrations, check_instructions
from worldenv_trl.language import instructions_of
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.world_models.base import (
    MEMORY_POSES,
    PADDED_ACTION_DIM,
    PADDED_ACTIONS,
    POSES,
    WorldModel,
    memory_key,
)
from worldenv_trl.world_models.cells import to_float, to_uint8
from worldenv_trl.world_models.diffusion_conditioning import ContextTokens, ViewGeometry, resized
from worldenv_trl.world_models.diffusion_config import CONDITION_CHANNELS, DiffusionWorldModelConfig
from worldenv_trl.world_models.diffusion_process import ddim, make_scheduler
from worldenv_trl.world_models.diffusion_training import diffusion_loss
from worldenv_trl.world_models.diffusion_unet import VideoUNet
from worldenv_trl.world_models.flow_matching import seeded_noise
from worldenv_trl.world_models.noise_seeds import noise_seeds

__all__ = ["Conditions", "DiffusionWorldModel"]

_ADDED_IDS = 3  # frames per second, gap between frames, noise of the memory: as many as Stable Video Diffusion's


@dataclass(frozen=True)
class Conditions:
    """What the UNet knows beside the noisy chunk, computed once for all steps; h is the height of all views."""

    memory: Tensor
    """Latents [B, M, z, h, w] of the remembered frames."""
    fixed: Tensor
    """[B, M + C, z + 1 + z + 6, h, w]: latents of the newest frame, the memory's mask, latents of action maps, rays."""
    context: Tensor
    """[B, M + C, L, D]."""


class DiffusionWorldModel(WorldModel, Pretrained):
    """Latent video diffusion, one chunk of C frames of all cameras a call (World-Env section 3.2, after EnerVerse-AC).

    A frozen VAE turns each frame into latents, those of all cameras one below the other, so that attention joins them.
    The UNet sees M remembered frames and the C noisy ones. Each carries, as further channels, the newest frame, a mask
    of what is remembered, the action map of the pose that forward kinematics predicts (through the same VAE) and the
    rays of every cell; each cross-attends to tokens of the newest image and of the actions. It predicts v of the noisy
    frames, DDIM takes the noise away.

    Reads a :func:`~worldenv_trl.world_models.request` and writes ``("frames", entry)`` uint8 [B, C, 3, H, W] of each
    camera. Noise is drawn per row from ``noise_seed``, from torch's generator when absent. ``num_denoise_steps`` and
    ``eta`` may be changed on the module at any time.

    Args:
        config: sizes, cameras and sampling settings. Weights are random; :func:`load_diffusers` brings pretrained ones.

    Raises:
        ValueError: missing cameras, frames of another size or dtype, a chunk of another length.
    """

    config_class: ClassVar[type] = DiffusionWorldModelConfig

    def __init__(self, config: DiffusionWorldModelConfig) -> None:
        from diffusers import AutoencoderKL

        check_instructions(config.cameras, "DiffusionWorldModelConfig")
        super().__init__(
            cameras=tuple(config.cameras),
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            instructions=config.instructions,
        )
        self.config = config
        self.num_denoise_steps, self.eta = config.num_denoise_steps, config.eta
        self.views = nn.ModuleList(
            ViewGeometry(Calibrations(by_text), config.frame_size, config.latent_size)
            for by_text in config.cameras.values()
        )
        self.vae: Any = AutoencoderKL.from_config(config.vae).eval().requires_grad_(False)
        self.latent_channels = int(self.vae.config.latent_channels)
        sizes = {
            "in_channels": 3 * self.latent_channels + CONDITION_CHANNELS,
            "out_channels": self.latent_channels,
            "addition_time_embed_dim": 256,
            "projection_class_embeddings_input_dim": 256 * _ADDED_IDS,
        }
        self.unet = VideoUNet(config.unet | sizes)
        if config.gradient_checkpointing:
            self.unet.checkpoint_activations()
        for module in self.modules():  # the layout of a GPU's convolutions
            if isinstance(module, nn.Conv2d):
                module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.context = ContextTokens(config)
        self.scheduler = make_scheduler()

    def train(self, mode: bool = True) -> DiffusionWorldModel:
        """The VAE and the image encoder are frozen: they stay in evaluation mode."""
        super().train(mode)
        self.vae.eval()
        self.context.encoder.eval()
        return self

    def weights_to(self, dtype: torch.dtype) -> DiffusionWorldModel:
        """Holds the networks' weights in ``dtype``; geometry stays in float32."""
        for network in (self.vae, self.unet, self.context):
            nn.Module.to(network, dtype)  # diffusers' own warns, whatever is in it
        return self

    def memory_indices(self, now: Tensor) -> Tensor:
        """Frames at equal parts of the video so far, the first and the last among them: int64 [B] -> [B, M]."""
        last = self.config.memory_frames - 1
        parts = torch.arange(last + 1, device=now.device)
        return now.unsqueeze(-1) * parts // last

    def training_loss(self, windows: TensorDictBase) -> TensorDict:
        """See :func:`~worldenv_trl.world_models.diffusion_training.diffusion_loss`."""
        return diffusion_loss(self, windows)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check(tensordict)
        texts, rows = instructions_of(tensordict), self.config.rows_at_once(tensordict[POSES].device)
        painted = [
            self._paint(tensordict[start : start + rows], texts[start : start + rows])
            for start in range(0, len(texts), rows)
        ]
        for index, camera in enumerate(self.cameras):
            tensordict.set(frames_key(camera), torch.cat([part[:, index] for part in painted]))
        return tensordict

    def _paint(self, tensordict: TensorDictBase, texts: Sequence[str]) -> Tensor:
        """uint8 [B, V, C, 3, H, W]."""
        images = self.decode(self.sample(tensordict, texts))
        size = (self.image_size, self.image_size)
        return to_uint8(resized(images.flatten(0, 2), size)).unflatten(0, images.shape[:3])

    @torch.no_grad()
    def sample(self, tensordict: TensorDictBase, texts: Sequence[str]) -> Tensor:
        """Latents float32 [B, C, z, h, w] of the chunk that a request asks for."""
        seed, conditions = tensordict.get(NOISE_SEED, None), self.conditions(tensordict, texts)
        shape = (self.chunk_length, *conditions.memory.shape[2:])

        def draw(step: int) -> Tensor:
            if seed is None:
                return torch.randn(len(texts), *shape, device=conditions.memory.device)
            row = seed.reshape(-1)
            return seeded_noise(noise_seeds(step, row) if step else row, shape)

        def predict(noisy: Tensor, timestep: int) -> Tensor:
            return self.predict_v(noisy, torch.full((len(texts),), timestep, device=noisy.device), conditions)

        return ddim(self.scheduler, predict, draw(0), self.num_denoise_steps, self.eta, draw)

    # ------------------------------------------------------------------------------------------------- network

    def predict_v(
        self, noisy: Tensor, timesteps: Tensor, conditions: Conditions, memory_noise: Tensor | None = None
    ) -> Tensor:
        """v of the noisy chunk.

        Args:
            noisy: [B, C, z, h, w].
            timesteps: int64 [B].
            conditions: of the chunk.
            memory_noise: [B], the standard deviation of what disturbs the memory; 0 when None.

        Returns:
            float32 [B, C, z, h, w].
        """
        count, remembered = conditions.memory.shape[:2]
        latents = torch.cat([conditions.memory, noisy], 1)
        sample = torch.cat([latents, conditions.fixed], 2).to(self.unet.dtype)
        times = timesteps.unsqueeze(-1) * (torch.arange(self.config.frames, device=noisy.device) >= remembered)
        added = torch.zeros(count, _ADDED_IDS, device=noisy.device)
        added[:, 0], added[:, 1] = CONTROL_HZ, 1
        if memory_noise is not None:
            added[:, 2] = 1000 * memory_noise
        with self._precision(noisy.device):
            return self.unet(sample, times, conditions.context, added)[:, remembered:].float()

    def conditions(self, tensordict: TensorDictBase, texts: Sequence[str]) -> Conditions:
        """Of a :func:`~worldenv_trl.world_models.request` [B]; only the resamplers' part has gradients."""
        poses = torch.cat([tensordict[MEMORY_POSES], tensordict[POSES]], 1).float()
        newest = self.config.memory_frames - 1
        memory, maps, rays, seen = [], [], [], []
        with torch.no_grad():
            for camera, module in zip(self.cameras, self.views, strict=True):
                view = cast(ViewGeometry, module)
                frames = to_float(tensordict[memory_key(camera)])  # [B, M, 3, H, W]
                seen.append(frames[:, -1])
                memory.append(self.encode(frames))
                maps.append(self.encode(view.maps(poses, newest, texts)))
                rays.append(view.rays(poses, texts))
            latents = torch.cat(memory, -2)  # views one below the other
            shape = (len(texts), self.config.frames, -1, *latents.shape[-2:])
            image = latents[:, -1:].expand(shape)
            mask = torch.zeros_like(image[:, :, :1])
            mask[:, : newest + 1] = 1
            fixed = torch.cat([image, mask, torch.cat(maps, -2), torch.cat(rays, -2)], 2)
        with self._precision(poses.device):
            context = self.context(torch.stack(seen, 1), tensordict[PADDED_ACTIONS].float())
        return Conditions(latents, fixed, context)

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Latents float32 [B, F, z, h, w] of images [B, F, 3, *, *] in [-1, 1], of one view."""

        def one(part: Tensor) -> Tensor:
            with self._precision(part.device):
                return self.vae.encode(part.to(self.vae.dtype)).latent_dist.mode().float()

        flat = resized(images.flatten(0, 1), self.config.frame_size)
        return self._in_parts(one, flat).unflatten(0, images.shape[:2]) * self.vae.config.scaling_factor

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Images float32 [B, V, C, 3, H, W] in [-1, 1] of the latents [B, C, z, V h, w] of all views."""

        def one(part: Tensor) -> Tensor:
            with self._precision(part.device):
                return self.vae.decode(part.to(self.vae.dtype)).sample.float()

        views = torch.stack(latents.chunk(len(self.cameras), -2), 1) / self.vae.config.scaling_factor
        return self._in_parts(one, views.flatten(0, 2)).unflatten(0, views.shape[:3]).clamp(-1, 1)

    def _in_parts(self, work: Callable[[Tensor], Tensor], images: Tensor) -> Tensor:
        return torch.cat([work(part) for part in images.split(self.config.frames_per_call)])

    def _precision(self, device: torch.device) -> AbstractContextManager:
        wanted = self.config.precision
        low = wanted == "bfloat16" or (wanted == "auto" and device.type == "cuda")
        # Weights that are bfloat16 already need nobody to cast them.
        if low and self.unet.dtype == torch.float32:
            return torch.autocast(device.type, torch.bfloat16)
        return nullcontext()

    def _check(self, tensordict: TensorDictBase) -> None:
        size, kept = self.image_size, self.config.memory_frames
        for camera in self.cameras:
            frames = tensordict.get(memory_key(camera), None)
            if frames is None or frames.dtype != torch.uint8 or tuple(frames.shape[1:]) != (kept, 3, size, size):
                got = "nothing" if frames is None else f"{frames.dtype} {tuple(frames.shape)}"
                raise ValueError(f"{memory_key(camera)} must be uint8 [B, {kept}, 3, {size}, {size}], got {got}")
        for key, width in ((POSES, POSE_DIM), (PADDED_ACTIONS, PADDED_ACTION_DIM)):
            if tuple(tensordict[key].shape[1:]) != (self.chunk_length, width):
                raise ValueError(f"{key} must be [B, {self.chunk_length}, {width}], got {tuple(tensordict[key].shape)}")
