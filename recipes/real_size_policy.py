"""Rows of real_size.py: vision-language-action policies of the sizes that people post-train."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from transformers import LlavaConfig, PretrainedConfig, SmolVLMConfig

from published_sizes import INSTRUCTION, LLAMA_2_7B, openvla_oft_7b, paligemma_3b, siglip_so400m, words
from real_size_row import Row
from worldenv_trl.keys import ACTION_DIM, STATE_DIM
from worldenv_trl.policies import (
    FASTConfig,
    FASTPolicy,
    HFConfig,
    HFPolicy,
    HFTokenConfig,
    HFTokenPolicy,
    Policy,
    TokenPolicy,
    token_cross_entropy,
)
from worldenv_trl.policies.prismatic import PrismaticConfig

CAMERAS = ("agentview", "wrist")
IMAGE_SIZE = 256  # px, LIBERO's
RANK = 32
ACTION_IDS = range(31744, 32000)  # OpenVLA's action tokens
Inputs = tuple[dict[str, Tensor], Tensor, list[str]]


def llava_7b() -> LlavaConfig:
    """LLaVA's layout with the same language model, and SigLIP-so400m alone."""
    return LlavaConfig(
        text_config=LLAMA_2_7B,
        vision_config=siglip_so400m(224),
        vision_feature_layer=-2,
        vision_feature_select_strategy="full",
        image_token_index=32000,
    )


def smolvlm_500m() -> SmolVLMConfig:
    """HuggingFaceTB/SmolVLM-500M's sizes; 64 tokens an image of 512 px."""
    text = {
        "model_type": "llama",
        "hidden_size": 960,
        "intermediate_size": 2560,
        "num_hidden_layers": 32,
        "num_attention_heads": 15,
        "num_key_value_heads": 5,
        "head_dim": 64,
        "vocab_size": 49280,
    }
    vision = {
        "hidden_size": 768,
        "intermediate_size": 3072,
        "num_hidden_layers": 12,
        "num_attention_heads": 12,
        "image_size": 512,
        "patch_size": 16,
    }
    return SmolVLMConfig(text_config=text, vision_config=vision, scale_factor=4, image_token_id=49190)


def make(backbone: PretrainedConfig | PrismaticConfig) -> HFPolicy:
    config = HFConfig(
        backbone=backbone.to_dict(),
        instructions=(INSTRUCTION,),
        cameras=CAMERAS,
        image_size=IMAGE_SIZE,
        attention="full",
        lora_rank=RANK,
        dtype="bfloat16",
        gradient_checkpointing=True,
    )
    return HFPolicy(config, words())


def inputs(policy: Policy, batch: int) -> Inputs:
    device = policy.action_range.device
    shape = (batch, 3, IMAGE_SIZE, IMAGE_SIZE)
    images = {camera: torch.randint(0, 256, shape, dtype=torch.uint8, device=device) for camera in policy.cameras}
    return images, torch.zeros(batch, STATE_DIM, device=device), [INSTRUCTION] * batch


def decide(policy: Policy, observed: Inputs) -> tuple[Tensor, Tensor]:
    return policy.predict(*observed)


def learning(policy: Policy) -> list[nn.Parameter]:
    return [parameter for group in policy.post_training_parameters(RANK).values() for parameter in group]


def negative_log_likelihood(policy: HFPolicy, observed: Inputs) -> Tensor:
    """Of a chunk of zeros: the forward and backward pass that LOOP and the scale head's training make."""
    loc, log_scale = policy.predict(*observed)
    return (loc.abs() / log_scale.exp() + log_scale).sum() / (loc.shape[0] * ACTION_DIM)


def make_tokens() -> HFTokenPolicy:
    """OpenVLA-7B: one camera, chunks of eight actions."""
    config = HFTokenConfig(
        backbone=openvla_oft_7b().to_dict(),
        instructions=(INSTRUCTION,),
        cameras=CAMERAS[:1],
        image_size=IMAGE_SIZE,
        action_token_end=ACTION_IDS[-1] + 1,
        lora_rank=RANK,
        dtype="bfloat16",
        gradient_checkpointing=True,
    )
    return HFTokenPolicy(config, words(ACTION_IDS))


def make_whole_chunks() -> FASTPolicy:
    """pi0-FAST-3B: chunks of eight actions, said in as many tokens as they have numbers, which is the most."""
    config = FASTConfig(
        backbone=paligemma_3b().to_dict(),
        instructions=(INSTRUCTION,),
        cameras=CAMERAS,
        image_size=IMAGE_SIZE,
        action_token_end=257152,
        fast_vocab_size=2048,
        lora_rank=RANK,
        dtype="bfloat16",
        gradient_checkpointing=True,
    )
    return FASTPolicy(config, words())


def cross_entropy(policy: TokenPolicy, observed: Inputs) -> Tensor:
    """Of a whole chunk's tokens: the pass that cloning and LOOP make."""
    tokens = torch.zeros(observed[1].shape[0], *policy.token_shape, dtype=torch.int64, device=observed[1].device)
    return token_cross_entropy(policy.logits(*observed, tokens), tokens).mean()


def read_by_later_tokens(policy: HFTokenPolicy | FASTPolicy) -> int:
    """The language model's layers and the head, for every token but the first."""
    read = [*policy.backbone.language_model.layers.parameters(), *policy.action_head.parameters()]
    return (math.prod(policy.token_shape) - 1) * sum(each.numel() * each.element_size() for each in read)


def compile_layers(policy: nn.Module) -> None:
    """Layer by layer: equal layers share one graph."""
    for module in policy.modules():
        if type(module).__name__.endswith(("DecoderLayer", "EncoderLayer")):
            module.compile(dynamic=False)


def row(name: str, backbone: PretrainedConfig | PrismaticConfig) -> Row:
    return Row(
        name=f"policy-{name}",
        unit="decision",
        make=partial(make, backbone),
        inputs=inputs,
        call=decide,
        train=learning,
        loss=negative_log_likelihood,
        compile=compile_layers,
    )


def token_row(name: str, make: Callable[[], TokenPolicy]) -> Row:
    return Row(
        name=f"policy-{name}",
        unit="decision",
        make=make,
        inputs=inputs,
        call=decide,
        train=learning,
        loss=cross_entropy,
        compile=compile_layers,
        read_again=read_by_later_tokens,
    )


ROWS = (
    row("openvla-oft-7b", openvla_oft_7b()),
    token_row("openvla-7b-tokens", make_tokens),
    token_row("pi0-fast-3b", make_whole_chunks),
    row("llava-7b", llava_7b()),
    row("paligemma-3b", paligemma_3b()),
    row("smolvlm-500m", smolvlm_500m()),
)
