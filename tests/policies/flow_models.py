"""Flow-matching policies as small as they can be, of random weights."""

from __future__ import annotations

import torch
from policies.hf_models import backbone
from policies.lerobot_folders import tokenizer
from policies.observations import INSTRUCTIONS

from worldenv_trl.policies import FlowConfig, FlowPolicy
from worldenv_trl.policies.flow_network import FLOW_FAMILIES


def flow_policy(kind: str = "smolvla", expert_layers: int = 2, **settings) -> FlowPolicy:
    torch.manual_seed(0)
    small = {
        "instructions": INSTRUCTIONS,
        "cameras": ("agentview",),
        "image_size": 64,
        "resolution": 28,
        "horizon": 10,
        "num_steps": 3,
        "max_state_dim": 9,
        "max_action_dim": 8,
        "self_every": 2 if kind == "smolvla" else 0,
        "lora_rank": 2,
        "head_dim": 48,
        "max_tokens": 200,
    }
    network = backbone(FLOW_FAMILIES[kind].backbone).to_dict()
    expert = {"hidden_size": 24, "intermediate_size": 40, "num_hidden_layers": expert_layers}
    return FlowPolicy(FlowConfig(kind, network, expert, **(small | settings)), tokenizer(True))
