"""Weights of LeRobot's folders by the names they have here, whatever transformers wrote them; sizes that they tell."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from worldenv_trl.policies.lerobot_files import LeRobotFolder

__all__ = ["assign_weights", "named_shapes", "named_tensors", "paligemma_sizes"]

VISION_HEADS = 16  # of PaliGemma's SigLIP; shapes of weights do not tell
_RENAMED = (
    (r"^model\.", ""),
    (r"^vlm_with_expert\.vlm\.model\.", "backbone.model."),
    (r"^vlm_with_expert\.vlm\.", "backbone."),
    (r"^vlm_with_expert\.lm_expert\.", "expert."),
    (r"^paligemma_with_expert\.paligemma\.(model\.)?", "backbone.model."),
    (r"^paligemma_with_expert\.gemma_expert\.(model\.)?", "expert."),
    (r"^backbone\.model\.language_model\.model\.", "backbone.model.language_model."),  # before transformers 4.52
    (r"^backbone\.model\.vision_tower\.vision_model\.", "backbone.model.vision_tower."),  # before transformers 5.6
    (r"^action_time_mlp_", "time_mlp_"),
)
_UNUSED = re.compile(r"^expert\.(lm_head|embed_tokens)\.|rotary_emb\.|^backbone\.model\.vision_tower\.head\.")


def paligemma_sizes(read: LeRobotFolder, shapes: Mapping[str, Sequence[int]], side: int) -> dict[str, Any]:
    """Sizes as the weights have them; what sizes do not tell, as all of openpi's have it."""
    text, vision = "backbone.model.language_model.", "backbone.model.vision_tower."
    patch = f"{vision}embeddings.patch_embedding.weight"
    keys, queries = (f"{text}layers.0.self_attn.{each}_proj.weight" for each in "kq")
    if patch not in shapes or keys not in shapes:
        raise ValueError(f"{read.folder} holds no weights of a PaliGemma: this is no {read.kind} of LeRobot")
    count = {
        name: 1 + max(int(each.split(".")[at]) for each in shapes if each.startswith(name))
        for name, at in ((f"{text}layers.", 4), (f"{vision}encoder.layers.", 5))
    }
    head_dim, width = shapes[keys]
    return {
        "model_type": "paligemma",
        "projection_dim": width,
        "image_token_index": shapes[f"{text}embed_tokens.weight"][0],
        "text_config": {
            "model_type": "gemma",
            "hidden_size": width,
            "intermediate_size": shapes[f"{text}layers.0.mlp.gate_proj.weight"][0],
            "num_hidden_layers": count[f"{text}layers."],
            "num_attention_heads": shapes[queries][0] // head_dim,
            "num_key_value_heads": 1,
            "head_dim": head_dim,
            "vocab_size": shapes[f"{text}embed_tokens.weight"][0],
        },
        "vision_config": {
            "model_type": "siglip_vision_model",
            "vision_use_head": False,
            "hidden_size": shapes[patch][0],
            "intermediate_size": shapes[f"{vision}encoder.layers.0.mlp.fc1.weight"][0],
            "num_hidden_layers": count[f"{vision}encoder.layers."],
            "num_attention_heads": VISION_HEADS,
            "patch_size": shapes[patch][-1],
            "image_size": side,
            "projection_dim": width,
        },
    }


def named_tensors(read: LeRobotFolder, dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
    """Weights by the names of :class:`~worldenv_trl.policies.flow_network.FlowNetwork`; its towers' in ``dtype``."""
    tensors = {}
    for old, tensor in read.tensors():
        name = _name(old)
        if name is not None:
            tower = name.startswith(("backbone.", "expert."))
            tensors[name] = tensor.to(device, dtype if tower else torch.float32)
    return _untied(tensors)


def named_shapes(read: LeRobotFolder) -> dict[str, Any]:
    """Shapes of these, without reading them."""
    return _untied({name: shape for name, shape in ((_name(name), shape) for name, shape in read.shapes()) if name})


def _name(name: str) -> str | None:
    for pattern, new in _RENAMED:
        name = re.sub(pattern, new, name)
    return None if _UNUSED.search(name) else name


def _untied(found: dict[str, Any]) -> dict[str, Any]:
    """Embeddings that were saved once, as the weights of the language-modelling head, under their own name."""
    heads = [name for name in found if name.endswith("lm_head.weight")]
    for name in heads:
        head = found.pop(name)
        text = (
            "text_model" if any(each.startswith("backbone.model.text_model.") for each in found) else "language_model"
        )
        found.setdefault(f"backbone.model.{text}.embed_tokens.weight", head)
    return found


def assign_weights(network: nn.Module, kept: Mapping[str, Tensor], read: LeRobotFolder) -> None:
    """Gives a network these weights, each in the dtype that it has there.

    Raises:
        ValueError: if one is missing, unknown, or of another shape.
    """
    wanted = network.state_dict()
    missing, unknown = sorted(set(wanted) - set(kept)), sorted(set(kept) - set(wanted))
    wrong = [name for name in wanted if name in kept and wanted[name].shape != kept[name].shape]
    if missing or unknown or wrong:
        found = [f"{len(missing)} tensors are missing ({', '.join(missing[:2])})"] if missing else []
        found += [f"{len(unknown)} are unknown ({', '.join(unknown[:2])})"] if unknown else []
        found += [f"{name} is {list(kept[name].shape)}, not {list(wanted[name].shape)}" for name in wrong[:1]]
        raise ValueError(f"{read.folder} does not hold the network of its config: {'; '.join(found)}")
    network.load_state_dict({name: tensor.to(wanted[name].dtype) for name, tensor in kept.items()}, assign=True)
