"""Rows of real_size.py: a LLaVA reflector and a video world model of the sizes that people train."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from transformers import AutoModelForImageTextToText

from published_sizes import INSTRUCTION, QWEN2_7B, WordTokens, llava_onevision
from real_size_row import Row
from worldenv_trl import keys
from worldenv_trl.language import instructions_of
from worldenv_trl.reflectors import VLMReflector, VLMReflectorConfig
from worldenv_trl.reflectors.video_language_model import VideoLanguageModel
from worldenv_trl.robot import WRIST, look_at
from worldenv_trl.world_models import DiffusionWorldModel, DiffusionWorldModelConfig, memory_key
from worldenv_trl.world_models.base import MEMORY_POSES, PADDED_ACTION_DIM, PADDED_ACTIONS, POSES
from worldenv_trl.world_models.diffusion_training import denoising_loss

IMAGE_SIZE = 256  # px, LIBERO's
FRONT = look_at("agentview", (0.66, 0.0, 1.61), (0.0, 0.0, 0.9), 45.0)

# ----------------------------------------------------------------------------------------------------- reflector


QWEN2_500M: dict[str, Any] = {
    "hidden_size": 896,
    "intermediate_size": 4864,
    "num_hidden_layers": 24,
    "num_attention_heads": 14,
    "num_key_value_heads": 2,
    "tie_word_embeddings": True,
}


def make_reflector(**text: Any) -> VLMReflector:
    config = llava_onevision(**text)
    model = AutoModelForImageTextToText.from_config(config, dtype=torch.bfloat16)
    vlm = VideoLanguageModel(model, WordTokens(config.video_token_id))
    return VLMReflector(VLMReflectorConfig("random/weights", instructions=(INSTRUCTION,)), vlm=vlm)


def watched(reflector: VLMReflector, batch: int) -> tuple[Tensor, Tensor, Tensor]:
    """A new frame of each video, the cached tokens of the 31 looked at beside it, and embeddings to learn from."""
    device, frames = reflector.log_scale.device, reflector.config.num_frames
    frame = torch.randint(0, 256, (batch, 3, IMAGE_SIZE, IMAGE_SIZE), dtype=torch.uint8, device=device)
    shape = (batch, frames - 1, reflector.vlm.tokens_per_frame, reflector.vlm.width)
    tokens = torch.randn(shape, dtype=torch.bfloat16, device=device)
    return frame, tokens, torch.randn(batch, reflector.vlm.width, device=device)


def score(reflector: VLMReflector, seen: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """One frame through the vision tower, one language pass over 32."""
    frame, tokens, _ = seen
    videos = torch.cat([tokens, reflector.vlm.encode(frame).unsqueeze(1)], 1)
    prompt = reflector.vlm.prompt_ids(reflector.config.text(INSTRUCTION))
    return reflector.judge(reflector.vlm.hidden(list(videos), [prompt] * len(videos)))


def head(reflector: VLMReflector) -> list[nn.Parameter]:
    return list(reflector.head.parameters())


def head_loss(reflector: VLMReflector, seen: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Of cached embeddings, as the head is trained."""
    return nn.functional.softplus(reflector.logits(seen[2])).mean()


def compile_layers(reflector: VLMReflector) -> None:
    """Layer by layer: equal layers share one graph."""
    for module in reflector.modules():
        if type(module).__name__.endswith(("DecoderLayer", "EncoderLayer")):
            module.compile(dynamic=False)


def reflector_row(name: str, **text: Any) -> Row:
    return Row(
        name=name,
        unit="score",
        make=partial(make_reflector, **text),
        inputs=watched,
        call=score,
        train=head,
        loss=head_loss,
        compile=compile_layers,
        train_batch=8,
    )


# --------------------------------------------------------------------------------------------------- world model


def make_world_model(**settings: Any) -> DiffusionWorldModel:
    cameras = {"agentview": {INSTRUCTION: FRONT}, "wrist": {INSTRUCTION: WRIST}}
    config = DiffusionWorldModelConfig.for_cameras(
        cameras, image_size=IMAGE_SIZE, precision="auto", gradient_checkpointing=True, **settings
    )
    # Some of diffusers' parameters are made on the CPU, whatever the default device is.
    return DiffusionWorldModel(config).eval().weights_to(torch.bfloat16).to(torch.get_default_device())


def asked(model: DiffusionWorldModel, batch: int) -> TensorDict:
    """A request of noise, and the frames to learn from."""
    device, kept, length = model.unet.net.device, model.config.memory_frames, model.chunk_length

    def video(count: int) -> Tensor:
        return torch.randint(0, 256, (batch, count, 3, IMAGE_SIZE, IMAGE_SIZE), dtype=torch.uint8, device=device)

    def poses(count: int) -> Tensor:
        upright = torch.eye(3, device=device).flatten().expand(batch, count, 9)
        place = 0.1 * torch.rand(batch, count, 3, device=device)
        return torch.cat([place, upright, torch.rand(batch, count, 1, device=device)], -1)

    entries = {POSES: poses(length), MEMORY_POSES: poses(kept)}
    entries |= {PADDED_ACTIONS: torch.rand(batch, length, PADDED_ACTION_DIM, device=device)}
    entries |= {memory_key(camera): video(kept) for camera in model.cameras}
    entries |= {("targets", camera): video(length) for camera in model.cameras}
    entries |= {keys.NOISE_SEED: torch.arange(batch, device=device).unsqueeze(-1)}
    out = TensorDict(entries, batch_size=[batch])
    out.set(keys.INSTRUCTION, INSTRUCTION)
    return out


def imagine(model: DiffusionWorldModel, request: TensorDict) -> TensorDict:
    """Everything: action maps, VAE, image encoder, DDIM, VAE."""
    return model(request)


def unet_and_resamplers(model: DiffusionWorldModel) -> list[nn.Parameter]:
    """Held in float32, computed in bfloat16 by autocast, which the meta device lacks: it counts float32 activations."""
    nn.Module.to(model.unet.train(), torch.float32)
    model.context.float()
    return [parameter for parameter in model.parameters() if parameter.requires_grad]


def denoising(model: DiffusionWorldModel, request: TensorDict) -> Tensor:
    videos = [request["targets", camera].float() * (2 / 255) - 1 for camera in model.cameras]
    clean = torch.cat([model.encode(video) for video in videos], -2)
    conditions = model.conditions(request, instructions_of(request))
    valid = torch.ones(clean.shape[:2], dtype=torch.bool, device=clean.device)
    return denoising_loss(model, clean, conditions, valid)["loss_world_model"]


def compile_unet(model: DiffusionWorldModel) -> None:
    """One graph, of which the sampler makes every step."""
    model.unet.compile(dynamic=False)


def world_model_row(name: str, batches: tuple[int, ...], **settings: Any) -> Row:
    return Row(
        name=name,
        unit="imagined frame",
        make=partial(make_world_model, **settings),
        inputs=asked,
        call=imagine,
        train=unet_and_resamplers,
        loss=denoising,
        compile=compile_unet,
        call_batches=batches,
        units_per_row=settings.get("chunk_length", 16),
    )


SMALL_UNET = {
    "block_out_channels": (160, 320, 640, 640),
    "layers_per_block": 2,
    "num_attention_heads": (5, 10, 20, 20),
    "cross_attention_dim": 512,
    "down_block_types": ("CrossAttnDownBlockSpatioTemporal",) * 3 + ("DownBlockSpatioTemporal",),
    "up_block_types": ("UpBlockSpatioTemporal",) + ("CrossAttnUpBlockSpatioTemporal",) * 3,
}
VIT_B = {  # CLIP ViT-B/16's sizes
    "model_type": "clip_vision_model",
    "hidden_size": 768,
    "intermediate_size": 3072,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "image_size": 224,
    "patch_size": 16,
}

ROWS = (
    reflector_row("reflector-llava-7b", **QWEN2_7B),
    reflector_row("reflector-llava-0.5b", **QWEN2_500M),
    world_model_row("world-model-evac-4-steps", (4,), num_denoise_steps=4),
    world_model_row(
        "world-model-small-4-steps", (8,), num_denoise_steps=4, chunk_length=8, frame_size=(160, 256),
        unet=SMALL_UNET, image_encoder=VIT_B,
    ),
)  # fmt: skip
