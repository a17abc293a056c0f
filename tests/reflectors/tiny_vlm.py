"""A LLaVA-OneVision of random weights, small enough for a test, saved as a checkpoint of transformers is."""

from __future__ import annotations

from pathlib import Path

import torch
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import (
    LlavaOnevisionConfig,
    LlavaOnevisionForConditionalGeneration,
    PreTrainedTokenizerFast,
    Qwen2Config,
    SiglipVisionConfig,
)

SPECIAL = ("<|im_start|>", "<|im_end|>", "<video>", "<image>", "<unk>")
WORDS = (
    "user",
    "assistant",
    "Does",
    "the",
    "robot",
    "in",
    "video",
    "complete",
    "task",
    ":",
    "?",
    ".",
    "Answer",
    "only",
)
WORDS += ("Yes", "No", "or", "push", "left", "right", "before", "open", "drawer", "top", "turn", "on", "stove")


def tiny_tokenizer() -> PreTrainedTokenizerFast:
    vocabulary = {word: number for number, word in enumerate((*SPECIAL, *WORDS))}
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, unk_token="<unk>", additional_special_tokens=list(SPECIAL[:4])
    )


def tiny_model(seed: int = 0, image_size: int = 24) -> LlavaOnevisionForConditionalGeneration:
    torch.manual_seed(seed)
    vision = SiglipVisionConfig(
        hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=image_size,
        patch_size=8, vision_use_head=False,
    )  # fmt: skip
    text = Qwen2Config(
        hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4, num_key_value_heads=2,
        vocab_size=len(SPECIAL) + len(WORDS), max_position_embeddings=2048,
    )  # fmt: skip
    config = LlavaOnevisionConfig(
        vision_config=vision, text_config=text, image_token_index=SPECIAL.index("<image>"),
        video_token_index=SPECIAL.index("<video>"),
    )  # fmt: skip
    model = LlavaOnevisionForConditionalGeneration(config)
    for parameter in model.parameters():  # at their start such small models say nearly the same of everything
        parameter.data += 0.1 * torch.randn_like(parameter)
    return model


def save_tiny_vlm(folder: Path, seed: int = 0) -> Path:
    tiny_model(seed).save_pretrained(folder)
    tiny_tokenizer().save_pretrained(folder)
    return folder
