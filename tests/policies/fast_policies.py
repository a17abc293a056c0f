"""Policies that say whole chunks in FAST's tokens, as small as they can be."""

from __future__ import annotations

import functools
import json

import torch
from policies.hf_models import RESOLUTION, backbone, tokenizer
from policies.observations import INSTRUCTIONS
from tokenizers import Tokenizer

from worldenv_trl.policies import FASTActionTokenizer, FASTConfig, FASTPolicy

CHUNK_LENGTH, VOCABULARY, SIZE, SKIP = 3, 160, 60, 4
MAX_TOKENS = 12

__all__ = ["CHUNK_LENGTH", "MAX_TOKENS", "SIZE", "SKIP", "VOCABULARY", "chunks", "fast_policy", "fast_words"]


@functools.cache
def fast_words(size: int = VOCABULARY, begins: bool = True) -> Tokenizer:
    """The tokenizer of the small models with pi0-FAST's prompt, its vocabulary filled up with words for actions."""
    fields = json.loads(tokenizer(begins).to_str())
    known = fields["model"]["vocab"]
    for word in ("Task", ",", "State", ";", "Action", "|", "128", "0", "255"):
        known.setdefault(word, len(known))
    known |= {f"<action{number}>": number for number in range(len(known), size)}
    return Tokenizer.from_str(json.dumps(fields))


def chunks(count: int = 40, length: int = CHUNK_LENGTH) -> torch.Tensor:
    """Smooth ones, of which some come twice."""
    generator = torch.Generator().manual_seed(3)
    slopes = torch.randint(-2, 3, (count, 1, 7), generator=generator) / 4
    return slopes * torch.linspace(0.5, 1, length)[:, None]


def fast_policy(family: str = "paligemma", fitted: bool = True, **settings) -> FASTPolicy:
    """Its head's weights are larger than at first, so that some tokens are likelier than others, the end among them."""
    torch.manual_seed(0)
    fields = backbone(family).to_dict()
    fields["text_config"]["vocab_size"] = VOCABULARY
    small = {"instructions": INSTRUCTIONS, "image_size": 64, "resolution": RESOLUTION, "lora_rank": 2}
    small |= {"chunk_length": CHUNK_LENGTH, "fast_vocab_size": SIZE, "skip_tokens": SKIP, "max_tokens": MAX_TOKENS}
    small |= {"fixed_tokenizer": True}
    config = FASTConfig(backbone=fields, **(small | settings))
    codec = FASTActionTokenizer(config.horizon, size=config.fast_vocab_size, max_tokens=config.max_tokens)
    if fitted:
        codec.fit(chunks(length=config.horizon), scale=4.0)
    policy = FASTPolicy(config, fast_words(begins=not family.startswith("qwen")), action_tokenizer=codec)
    with torch.no_grad():
        policy.action_head.weight.mul_(4)
        policy.action_head.weight[-1] *= 2
    return policy
