"""Vision-language models of every family, as small as they can be, and policies over them."""

from __future__ import annotations

import functools

import pytest
import torch
from policies.observations import INSTRUCTIONS

pytest.importorskip("transformers")

from tokenizers import Tokenizer, models, pre_tokenizers, processors
from transformers import (
    Idefics3Config,
    LlavaConfig,
    PaliGemmaConfig,
    PretrainedConfig,
    Qwen2_5_VLConfig,
    Qwen2VLConfig,
    SmolVLMConfig,
)

from worldenv_trl.policies import HFConfig, HFPolicy
from worldenv_trl.policies.prismatic import PrismaticConfig

RESOLUTION = 28
SPECIAL = ["<s>", "<image>", "<fake_token_around_image>", "<global-img>", "<|vision_start|>", "<|vision_end|>"]
IMAGE_ID = 2
TEXT = {
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 2,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "head_dim": 8,
    "vocab_size": 64,
    "max_position_embeddings": 256,
    "pad_token_id": 0,
    "bos_token_id": 1,
    "eos_token_id": 1,
}
VISION = {
    "hidden_size": 24,
    "intermediate_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": RESOLUTION,
    "patch_size": 7,
}
ROPE = {"rope_type": "default", "mrope_section": [1, 1, 2], "rope_theta": 1e4}


def _paligemma(**text) -> PaliGemmaConfig:
    return PaliGemmaConfig(
        text_config=TEXT | text,
        vision_config={"model_type": "siglip_vision_model", "vision_use_head": False, **VISION},
        image_token_index=IMAGE_ID,
        projection_dim=32,
    )


FAMILIES = {
    "llava": lambda: LlavaConfig(
        text_config={"model_type": "llama", **TEXT},
        vision_config={"model_type": "clip_vision_model", "projection_dim": 24, **VISION},
        image_token_index=IMAGE_ID,
    ),
    "paligemma": lambda: _paligemma(model_type="gemma"),
    "paligemma2": lambda: _paligemma(model_type="gemma2", sliding_window=64, query_pre_attn_scalar=8),
    "idefics3": lambda: Idefics3Config(
        text_config={"model_type": "llama", **TEXT}, vision_config=VISION, image_token_id=IMAGE_ID, scale_factor=2
    ),
    "smolvlm": lambda: SmolVLMConfig(
        text_config={"model_type": "llama", **TEXT}, vision_config=VISION, image_token_id=IMAGE_ID, scale_factor=2
    ),
    "qwen2_vl": lambda: Qwen2VLConfig(
        text_config=TEXT | {"rope_parameters": ROPE},
        vision_config={"embed_dim": 24, "hidden_size": 32, "depth": 2, "num_heads": 2, "patch_size": 7},
        image_token_id=IMAGE_ID,
    ),
    "qwen2_5_vl": lambda: Qwen2_5_VLConfig(
        text_config=TEXT | {"rope_parameters": ROPE},
        vision_config={
            "hidden_size": 24,
            "intermediate_size": 32,
            "depth": 2,
            "num_heads": 2,
            "patch_size": 7,
            "window_size": 14,
            "out_hidden_size": 32,
            "fullatt_block_indexes": [1],
        },
        image_token_id=IMAGE_ID,
    ),
    "prismatic": lambda: PrismaticConfig(
        {"model_type": "llama", **TEXT},
        {
            "image_size": RESOLUTION,
            "towers": [
                {"dim": 16, "depth": 2, "num_heads": 2, "mlp_dim": 24, "patch_size": 7, "class_token": True}
                | {"registers": 2, "layer_scale": True},
                {"dim": 24, "depth": 2, "num_heads": 2, "mlp_dim": 32, "patch_size": 7},
            ],
        },
    ),
}


def backbone(family: str) -> PretrainedConfig | PrismaticConfig:
    return FAMILIES[family]()


@functools.cache
def tokenizer(begins: bool = True) -> Tokenizer:
    """A token a word; ``begins``: every text begins with ``<s>``."""
    sentence = ["In", ":", "What", "action", "should", "the", "robot", "take", "to", "?", "Out"]
    known = ["<unk>", *SPECIAL, *sentence, *(word for text in INSTRUCTIONS for word in text.split())]
    made = Tokenizer(models.WordLevel({w: i for i, w in enumerate(dict.fromkeys(known))}, unk_token="<unk>"))
    made.pre_tokenizer = pre_tokenizers.Whitespace()
    made.add_special_tokens(SPECIAL)
    if begins:
        made.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    return made


def hf_policy(family: str = "smolvlm", **settings) -> HFPolicy:
    """Its last layers' weights are larger than at first, so that outputs differ from row to row."""
    torch.manual_seed(0)
    small = {"instructions": INSTRUCTIONS, "image_size": 64, "resolution": RESOLUTION, "lora_rank": 2, "head_dim": 48}
    config = HFConfig(backbone=backbone(family).to_dict(), **(small | settings))
    return HFPolicy(config, tokenizer(begins=not family.startswith("qwen")))
