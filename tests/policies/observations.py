"""Observations that policies are tested on, and the smallest of the compact policies."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NonTensorStack, TensorDict

from worldenv_trl.keys import INSTRUCTION, STATE, image_key
from worldenv_trl.policies import OFTConfig, OFTPolicy

INSTRUCTIONS = ("put the bowl on the plate", "open the top drawer", "turn on the stove")
TEXTS = [INSTRUCTIONS[i] for i in (0, 1, 2, 1, 0, 2)]


def oft_policy(**settings) -> OFTPolicy:
    torch.manual_seed(0)
    small = {"instructions": INSTRUCTIONS, "dim": 32, "depth": 2, "stem_widths": (8, 16), "head_dim": 48}
    return OFTPolicy(OFTConfig(**(small | settings)))


def observed(cameras: Sequence[str] = ("agentview",), size: int = 64, texts: Sequence[str] | str = TEXTS) -> TensorDict:
    """Six rows of noise."""
    generator = torch.Generator().manual_seed(1)
    td = TensorDict(batch_size=[6])
    for camera in cameras:
        shape = (6, 3, size, size)
        td[image_key(camera)] = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)
    td[STATE] = torch.randn(6, 7, generator=generator)
    td[INSTRUCTION] = texts if isinstance(texts, str) else NonTensorStack(*texts)
    return td
