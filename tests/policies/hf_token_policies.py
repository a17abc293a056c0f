"""Policies that act by tokens over vision-language models, as small as they can be."""

from __future__ import annotations

import functools
import json

import torch
from policies.hf_models import FAMILIES, RESOLUTION, TEXT, backbone, tokenizer
from policies.observations import INSTRUCTIONS
from tokenizers import Tokenizer

from worldenv_trl.policies import HFTokenConfig, HFTokenPolicy

BINS, CHUNK_LENGTH = 16, 2
VOCABULARY = TEXT["vocab_size"]

__all__ = ["BINS", "CHUNK_LENGTH", "FAMILIES", "VOCABULARY", "action_words", "token_policy"]


@functools.cache
def action_words(begins: bool = True, size: int = VOCABULARY) -> Tokenizer:
    """The tokenizer of the small models, its vocabulary filled up with words for actions."""
    fields = json.loads(tokenizer(begins).to_str())
    known = fields["model"]["vocab"]
    known |= {f"<action{number}>": number for number in range(len(known), size)}
    return Tokenizer.from_str(json.dumps(fields))


def token_policy(family: str = "smolvlm", **settings) -> HFTokenPolicy:
    """Its head's weights are larger than at first, so that some tokens are likelier than others."""
    torch.manual_seed(0)
    small = {"instructions": INSTRUCTIONS, "image_size": 64, "resolution": RESOLUTION, "lora_rank": 2}
    small |= {"num_bins": BINS, "action_token_end": VOCABULARY, "chunk_length": CHUNK_LENGTH}
    config = HFTokenConfig(backbone=backbone(family).to_dict(), **(small | settings))
    policy = HFTokenPolicy(config, action_words(not family.startswith("qwen")))
    with torch.no_grad():
        policy.action_head.weight.mul_(4)
    return policy
