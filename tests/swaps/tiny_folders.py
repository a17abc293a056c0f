"""Folders of pretrained weights as users bring them, of random weights and small enough for a test."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.extend(str(Path(__file__).parents[1] / name) for name in ("world_models", "reflectors"))

import torch
from diffusers import AutoencoderKL, UNetSpatioTemporalConditionModel
from policies import hf_models
from small_diffusion import CLIP, UNET, VAE
from tiny_vlm import save_tiny_vlm
from transformers import AutoModelForImageTextToText, CLIPVisionConfig, CLIPVisionModel

FRAME_SIZE = (16, 24)
_CHANNELS = {
    "in_channels": 8,
    "out_channels": 4,
    "addition_time_embed_dim": 256,
    "projection_class_embeddings_input_dim": 768,
}


def save_folders(root: Path) -> dict[str, Path]:
    """A SmolVLM, a LLaVA-OneVision and a video model of diffusers below ``root``, by part."""
    torch.manual_seed(0)
    folders = {name: root / name for name in ("policy", "reflector", "world_model")}
    AutoModelForImageTextToText.from_config(hf_models.backbone("smolvlm")).save_pretrained(folders["policy"])
    hf_models.tokenizer().save(str(folders["policy"] / "tokenizer.json"))
    save_tiny_vlm(folders["reflector"])
    clip = CLIPVisionConfig(**{key: value for key, value in CLIP.items() if key != "model_type"})
    parts = {
        "vae": AutoencoderKL.from_config(VAE),
        "unet": UNetSpatioTemporalConditionModel.from_config(UNET | _CHANNELS),
        "image_encoder": CLIPVisionModel(clip),
    }
    for name, part in parts.items():
        part.save_pretrained(folders["world_model"] / name)
    return folders
