"""LoRA adapters (peft) on the linear layers of a pretrained network."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

__all__ = ["check_adapters", "inject_adapters"]


def check_adapters(rank: int, alpha: int) -> None:
    """Raises ``ValueError`` for a config's ``lora_rank`` or ``lora_alpha`` below 0."""
    if rank < 0 or alpha < 0:
        raise ValueError(f"lora_rank and lora_alpha must not be negative, got {rank}, {alpha}")


def inject_adapters(network: nn.Module, rank: int, alpha: int, dtype: torch.dtype) -> None:
    """Puts adapters on every linear layer of a network, in place, and freezes the rest of it.

    Args:
        network: what is adapted.
        rank: of the adapters.
        alpha: their gain times the rank; at most 16 and no more than the rank when 0, as in OpenVLA-OFT.
        dtype: of the network's weights; adapters are float32.
    """
    import peft  # imported where used: it takes seconds

    kinds = nn.modules.linear.NonDynamicallyQuantizableLinear  # of nn.MultiheadAttention, which calls no module
    targets = [
        name
        for name, module in network.named_modules()
        if isinstance(module, nn.Linear) and not isinstance(module, kinds)
    ]
    lora = peft.LoraConfig(r=rank, lora_alpha=alpha or min(rank, 16), target_modules=targets)
    network.requires_grad_(False)
    peft.inject_adapter_in_model(lora, network)
    device = next(network.parameters()).device
    for name, parameter in network.named_parameters():
        if "lora_" in name:  # small steps are lost in bfloat16
            parameter.data = parameter.data.to(device, torch.float32)
            parameter.requires_grad_(True)
    if torch.amp.is_autocast_available(device.type):
        adapted: list[Any] = [module for module in network.modules() if hasattr(module, "lora_A")]
        for module in adapted:  # the autocast does what peft would do by a copy in float32
            module.cast_input_dtype_enabled = dtype == torch.float32
