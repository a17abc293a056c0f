"""Published sizes of the parts that people bring, for plans and benchmarks that have no weights at hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import torch
from tokenizers import Tokenizer, models, pre_tokenizers, processors
from transformers import AutoModelForImageTextToText, LlavaOnevisionConfig, PaliGemmaConfig

from config import WorldEnvConfig
from real_parts import action_head, outlined_world_model, policy_settings, reflector_config
from worldenv_trl.policies.fast import FASTConfig, FASTPolicy
from worldenv_trl.policies.hf import HFConfig, HFPolicy
from worldenv_trl.policies.hf_tokens import HFTokenConfig, HFTokenPolicy
from worldenv_trl.policies.prismatic import PrismaticConfig, dinosiglip_towers
from worldenv_trl.reflectors import VLMReflector
from worldenv_trl.reflectors.video_language_model import VideoLanguageModel

INSTRUCTION = "put the wine bottle on top of the cabinet"

LLAMA_2_7B: dict[str, Any] = {
    "model_type": "llama",
    "hidden_size": 4096,
    "intermediate_size": 11008,
    "num_hidden_layers": 32,
    "num_attention_heads": 32,
    "vocab_size": 32064,
}


def openvla_oft_7b() -> PrismaticConfig:
    """OpenVLA-OFT: Llama-2-7B behind DINOv2-L and SigLIP-so400m at 224 px."""
    towers = [dataclasses.asdict(tower) for tower in dinosiglip_towers()]
    return PrismaticConfig(LLAMA_2_7B, {"image_size": 224, "towers": towers})


def siglip_so400m(image_size: int) -> dict:
    return {
        "model_type": "siglip_vision_model",
        "hidden_size": 1152,
        "intermediate_size": 4304,
        "num_hidden_layers": 27,
        "num_attention_heads": 16,
        "image_size": image_size,
        "patch_size": 14,
        "vision_use_head": False,
    }


def paligemma_3b() -> PaliGemmaConfig:
    """google/paligemma-3b-pt-224's sizes."""
    text = {
        "model_type": "gemma",
        "hidden_size": 2048,
        "intermediate_size": 16384,
        "num_hidden_layers": 18,
        "num_attention_heads": 8,
        "num_key_value_heads": 1,
        "head_dim": 256,
        "vocab_size": 257216,
    }
    return PaliGemmaConfig(
        text_config=text, vision_config=siglip_so400m(224), image_token_index=257152, projection_dim=2048
    )


def words(action_tokens: Sequence[int] = ()) -> Tokenizer:
    """One token a word: prompts come out about as long as with a real tokenizer; and tokens of these ids."""
    special = ["<s>", "<fake_token_around_image>", "<global-img>"]
    known = [
        *special,
        FASTConfig.end,
        *HFConfig.prompt.format(instruction=INSTRUCTION).replace(":", " : ").replace("?", " ? ").split(),
    ]
    numbers = {word: number for number, word in enumerate(dict.fromkeys(["<unk>", *known]))}
    numbers |= {f"<{number}>": number for number in action_tokens}
    tokenizer = Tokenizer(models.WordLevel(numbers, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.add_special_tokens(special)
    tokenizer.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", numbers["<s>"])])
    return tokenizer


def llava_onevision(**text: Any) -> LlavaOnevisionConfig:
    """llava-hf/llava-onevision-qwen2-*-ov-hf's sizes: SigLIP-so400m at 384 px before Qwen2."""
    return LlavaOnevisionConfig(text_config={"model_type": "qwen2", "vocab_size": 152064, **text})


QWEN2_7B: dict[str, Any] = {
    "hidden_size": 3584,
    "intermediate_size": 18944,
    "num_hidden_layers": 28,
    "num_attention_heads": 28,
    "num_key_value_heads": 4,
}


class WordTokens:
    """One token a word: prompts come out about as long as with a real tokenizer."""

    def __init__(self, video_token: int) -> None:
        self._video_token = video_token

    def __call__(self, text: str, add_special_tokens: bool = True) -> SimpleNamespace:
        words = enumerate(text.replace("?", " ? ").split())
        return SimpleNamespace(input_ids=[self._video_token if "<video>" in word else place for place, word in words])


def outlined_policy(config: WorldEnvConfig) -> HFPolicy | HFTokenPolicy | FASTPolicy:
    """OpenVLA-OFT-7B on the meta device, or OpenVLA-7B or pi0-FAST-3B, which act by tokens."""
    settings = policy_settings(config) | {"chunk_length": 8, "proprio_format": "libero", "readout_shift": 1}
    with torch.device("meta"):
        if action_head(config) == "fast":
            tokens = policy_settings(config) | {"chunk_length": config.chunk_length, "action_token_end": 257152}
            sizes = {"backbone": paligemma_3b().to_dict(), "fast_vocab_size": 2048}
            return FASTPolicy(FASTConfig(**sizes, **tokens), words())
        if action_head(config) == "tokens":
            tokens = policy_settings(config) | {"chunk_length": config.chunk_length, "action_token_end": 32000}
            backbone = openvla_oft_7b().to_dict()
            return HFTokenPolicy(HFTokenConfig(backbone=backbone, **tokens), words(range(31744, 32000)))
        return HFPolicy(HFConfig(backbone=openvla_oft_7b().to_dict(), **settings), words())


def outlined_reflector(config: WorldEnvConfig) -> VLMReflector:
    """LLaVA-OneVision-7B on the meta device."""
    fields = llava_onevision(**QWEN2_7B)
    dtype = getattr(torch, config.real_size.dtype)
    with torch.device("meta"):
        model = AutoModelForImageTextToText.from_config(fields, dtype=dtype)
        vlm = VideoLanguageModel(model, WordTokens(fields.video_token_id))
        return VLMReflector(reflector_config(config, "published/sizes"), vlm=vlm)


PUBLISHED = {"policy": outlined_policy, "world_model": outlined_world_model, "reflector": outlined_reflector}
"""By part, what stands for it on the meta device while no folder is named: OpenVLA-OFT-7B, EVAC's world model and
LLaVA-OneVision-7B."""
