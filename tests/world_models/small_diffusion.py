"""Diffusion world models of random weights, small enough for a test, and what they are asked."""

from __future__ import annotations

import torch
from small_models import DOWN, ONE, PULL
from tensordict import TensorDict

from worldenv_trl.keys import frames_key
from worldenv_trl.world_models import DiffusionWorldModel, DiffusionWorldModelConfig, request

VAE = {
    "block_out_channels": (8, 16), "down_block_types": ("DownEncoderBlock2D",) * 2,
    "up_block_types": ("UpDecoderBlock2D",) * 2, "layers_per_block": 1, "norm_num_groups": 4, "latent_channels": 4,
    "scaling_factor": 0.5,
}  # fmt: skip
UNET = {
    "block_out_channels": (32, 32), "layers_per_block": 1, "num_attention_heads": (2, 2), "cross_attention_dim": 16,
    "down_block_types": ("CrossAttnDownBlockSpatioTemporal", "DownBlockSpatioTemporal"),
    "up_block_types": ("UpBlockSpatioTemporal", "CrossAttnUpBlockSpatioTemporal"),
}  # fmt: skip
CLIP = {
    "model_type": "clip_vision_model", "hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1,
    "num_attention_heads": 2, "image_size": 16, "patch_size": 8,
}  # fmt: skip
SMALL = {
    "image_size": 32, "frame_size": (16, 24), "chunk_length": 4, "vae": VAE, "unet": UNET, "image_encoder": CLIP,
    "context_queries": 2, "resampler_depth": 1, "resampler_heads": 2, "resampler_head_dim": 8, "num_denoise_steps": 3,
}  # fmt: skip


def make_diffusion(cameras=ONE, **settings) -> DiffusionWorldModel:
    torch.manual_seed(0)
    return DiffusionWorldModel(DiffusionWorldModelConfig.for_cameras(cameras, **{**SMALL, **settings})).eval()


def ask(model: DiffusionWorldModel, rows: int, now: int = 20, texts=None):
    """A request [n] at frame ``now`` of videos of noise; the hand wanders above the table, pointing down."""
    generator = torch.Generator().manual_seed(1)
    length, size = now + model.chunk_length + 1, model.image_size
    poses = torch.zeros(rows, length, 13)
    poses[..., :3] = 0.1 * torch.rand(rows, length, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.1])
    poses[..., 3:12] = DOWN.flatten()
    shape = (rows, length, 3, size, size)
    video = {
        frames_key(camera): torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)
        for camera in model.cameras
    }
    known, row = TensorDict({**video, "poses": poses}, batch_size=[rows, length]), torch.arange(rows).unsqueeze(-1)
    return request(
        model,
        lambda numbers: known[row, numbers],
        torch.full((rows,), now),
        poses[:, now + 1 :],
        torch.rand(rows, model.chunk_length, 7, generator=generator) * 2 - 1,
        texts or [PULL] * rows,
        noise_seed=torch.arange(rows).unsqueeze(-1) + 2**60,
    )
