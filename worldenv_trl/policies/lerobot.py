"""LeRobot's folders of SmolVLA, pi0 and pi0.5 as a :class:`~worldenv_trl.policies.FlowPolicy`."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from worldenv_trl import hub
from worldenv_trl.keys import ACTION_DIM, STATE_DIM
from worldenv_trl.policies.flow import FlowConfig, FlowPolicy, make_network
from worldenv_trl.policies.flow_network import FLOW_FAMILIES, FlowNetwork
from worldenv_trl.policies.hf_backbone import backbone_config
from worldenv_trl.policies.hf_files import read_json, read_tokenizer
from worldenv_trl.policies.lerobot_files import Affine, LeRobotFolder, read_lerobot_folder

if TYPE_CHECKING:
    from tokenizers import Tokenizer

__all__ = ["load_lerobot"]

STATE, ACTION = "observation.state", "action"
CAMERAS = ("agentview", "wrist")
DTYPE = "bfloat16"  # of the towers, where nothing else is asked for
PALIGEMMA = "google/paligemma-3b-pt-224"  # whose tokenizer pi0 and pi0.5 read with
VISION_HEADS = 16  # of PaliGemma's SigLIP; shapes of weights do not tell
_NEEDED = ("chunk_size", "max_state_dim", "max_action_dim", "tokenizer_max_length")
# What other robots and other trainings switch on, and is not done here.
_UNKNOWN = ("adapt_to_pi_aloha", "use_relative_actions", "use_visual_memory", "use_proprioceptive_memory")
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
# Nothing of the flow reads these.
_UNUSED = re.compile(
    r"^expert\.(lm_head|embed_tokens)\.|rotary_emb\.|^backbone\.model\.vision_tower\.head\.|"
    r"^backbone\.model\.(text_model|language_model)\.norm\."
)


def load_lerobot(
    folder: str | os.PathLike,
    *,
    cameras: Sequence[str] | None = None,
    image_features: Sequence[str] | None = None,
    backbone: str | os.PathLike | None = None,
    device: str | torch.device = "cpu",
    **settings: Any,
) -> FlowPolicy:
    """The policy of a folder that LeRobot wrote, of type ``smolvla``, ``pi0`` or ``pi05``.

    Network and statistics are the checkpoint's; the scale head is new, for a flow has none: train it before LOOP. Its
    actions must be 7 numbers in the env's convention, and its proprioception LIBERO's 8 or the env's 7, unless the
    statistics are fitted to other data (``fixed_statistics=False``): then what it was trained on is only where
    fine-tuning begins. Images are as the checkpoint's data set has them: ``mirror=True`` for LIBERO's.

    Args:
        folder: with ``config.json``, ``model.safetensors`` and, since LeRobot 0.4, ``policy_preprocessor.json`` and
            ``policy_postprocessor.json`` with their safetensors; or ``owner/name`` of a repository of the Hub.

    Keyword Args:
        cameras: the scene's for each image feature, in order; ``agentview`` and ``wrist``, as many as there are, when
            None.
        image_features: which of the policy's image features these are; all when None. A policy that was trained
            with a camera missing at times does without it.
        backbone: folder, or repository, of the vision-language model, of which ``tokenizer.json`` and, for SmolVLA,
            ``config.json`` are read. When None, ``tokenizer.json`` or ``tokenizer/`` of the policy's own folder, and
            what its config names.
        device: of the parameters; on ``meta`` no weights are read.
        settings: other fields of :class:`~worldenv_trl.policies.FlowConfig`; ``chunk_length`` is the policy's
            ``n_action_steps``, ``dtype`` bfloat16 and ``lora_rank`` 32 unless they say otherwise.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: for another kind or type of checkpoint, pickled weights, another number of cameras, a missing
            statistic, features that are not this arm's, or weights that do not fit.
    """
    read = read_lerobot_folder(folder, tuple(FLOW_FAMILIES))
    wanted = tuple(image_features or read.image_features)
    cameras = CAMERAS[: len(wanted)] if cameras is None else tuple(cameras)
    _check(read, cameras, wanted)
    tokenizer, described = _backbone(read, backbone)
    fixed = bool(settings.get("fixed_statistics", True))
    config = FlowConfig(**(_settings(read, _shapes(read), described, fixed) | {"cameras": cameras} | settings))
    statistics = (read.normalizer(STATE), read.normalizer(ACTION)) if fixed else None
    policy = FlowPolicy(config, tokenizer, _network(config, tokenizer, read, torch.device(device)))
    if statistics is not None:
        _set_statistics(policy, *statistics, read.half_range(ACTION))
    return policy.to(device)


def _check(read: LeRobotFolder, cameras: Sequence[str], wanted: Sequence[str]) -> None:
    known = read.image_features
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise ValueError(f"{read.folder} has no image feature {unknown[0]!r}: image_features= of {', '.join(known)}")
    if len(cameras) != len(wanted):
        raise ValueError(
            f"{read.folder} looks through {len(wanted)} cameras ({', '.join(wanted)}), got {len(cameras)} "
            f"({', '.join(cameras)}): name one for each in cameras=, or in image_features= those that there are"
        )
    if read.normalization.get("VISUAL", "IDENTITY") != "IDENTITY":
        raise ValueError(
            f"{read.folder} normalises images by {read.normalization['VISUAL']}: a {read.kind} that does is not known"
        )
    for option in _UNKNOWN:
        if read.fields.get(option):
            raise ValueError(f"{read.folder} was trained with {option}, which is not known: LeRobot alone runs it")
    if read.fields.get("add_image_special_tokens") and read.fields.get("empty_cameras"):
        raise ValueError(f"{read.folder} puts tokens around images of cameras that are not there: this is not known")
    if read.fields.get("n_obs_steps", 1) != 1:
        raise ValueError(f"{read.folder} looks at {read.fields['n_obs_steps']} observations: only 1 is known")
    missing = [name for name in _NEEDED if name not in read.fields]
    if missing:
        raise ValueError(f"{read.folder / 'config.json'} lacks {', '.join(missing)}: fetch it again")
    for name, features in ((STATE, read.inputs), (ACTION, read.outputs)):
        if name not in features:
            raise ValueError(
                f"{read.folder / 'config.json'} has no feature {name}: there are {', '.join(features) or 'none'}"
            )


def _settings(
    read: LeRobotFolder, shapes: Mapping[str, Sequence[int]], described: Mapping[str, Any], fixed: bool
) -> dict[str, Any]:
    fields, layers = read.fields, "expert.layers."
    state, action = read.inputs[STATE].shape, read.outputs[ACTION].shape
    if fixed and (action != (ACTION_DIM,) or state not in ((STATE_DIM,), (STATE_DIM + 1,))):
        raise ValueError(
            f"{read.folder} was trained for states {list(state)} and actions {list(action)}, this arm has "
            f"[{STATE_DIM}] (LIBERO's: [{STATE_DIM + 1}]) and [{ACTION_DIM}]: fixed_statistics=False begins with "
            "its weights and normalises by your data"
        )
    # Of a mask of another shape than a square's, padding would have to be made.
    side = fields.get("resize_imgs_with_padding" if read.kind == "smolvla" else "image_resolution", (224, 224))
    if not side or side[0] != side[1]:
        raise ValueError(f"{read.folder} resizes images to {side}: only squares are known")
    count = 1 + max((int(name.split(".")[2]) for name in shapes if name.startswith(layers)), default=-1)
    if not count:
        raise ValueError(f"{read.folder} holds no weights of an action expert: this is no {read.kind} of LeRobot")
    expert = {
        "hidden_size": shapes[f"{layers}0.self_attn.q_proj.weight"][1],
        "intermediate_size": shapes[f"{layers}0.mlp.gate_proj.weight"][0],
        "num_hidden_layers": count,
    }
    crossing = read.kind == "smolvla" and "cross" in fields.get("attention_mode", "cross_attn")
    network = _smolvlm(described, shapes, fields) if read.kind == "smolvla" else _paligemma(read, shapes, side[0])
    mean_std = read.normalization.get("ACTION") == "MEAN_STD"
    return {
        "kind": read.kind,
        "backbone": network,
        "expert": expert,
        "chunk_length": fields.get("n_action_steps", 1),
        "horizon": fields["chunk_size"],
        "num_steps": fields.get("num_steps" if read.kind == "smolvla" else "num_inference_steps", 10),
        "resolution": side[0],
        "image_tokens": bool(fields.get("add_image_special_tokens")),
        "max_tokens": fields["tokenizer_max_length"],
        "proprio_format": "state" if state == (STATE_DIM,) else "libero",
        "max_state_dim": fields["max_state_dim"],
        "max_action_dim": fields["max_action_dim"],
        "self_every": fields.get("self_attn_every_n_layers", 2) if crossing else 0,
        "min_period": fields.get("min_period", 4e-3),
        "max_period": fields.get("max_period", 4.0),
        "normalization": "mean_std" if mean_std else "quantiles",
        "fixed_statistics": fixed,
        "dtype": DTYPE,
    }


def _smolvlm(
    described: Mapping[str, Any], shapes: Mapping[str, Sequence[int]], fields: Mapping[str, Any]
) -> dict[str, Any]:
    described = backbone_config(described).to_dict()
    text = described["text_config"]
    layers = "backbone.model.text_model.layers."
    found = 1 + max((int(name.split(".")[4]) for name in shapes if name.startswith(layers)), default=-1)
    used = fields.get("num_vlm_layers", 16)
    text["num_hidden_layers"] = min(found, used) if used > 0 else found
    if "backbone.model.text_model.embed_tokens.weight" in shapes:
        text["vocab_size"] = shapes["backbone.model.text_model.embed_tokens.weight"][0]
    return described


def _paligemma(read: LeRobotFolder, shapes: Mapping[str, Sequence[int]], side: int) -> dict[str, Any]:
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


def _backbone(read: LeRobotFolder, named: str | os.PathLike | None) -> tuple[Tokenizer, dict[str, Any]]:
    """The tokenizer and, of SmolVLA's, the fields of the backbone's config: weights do not tell all of its sizes."""
    smolvla = read.kind == "smolvla"
    places = [Path(named)] if named else [read.folder, read.folder / "tokenizer"]
    own = next((place for place in places if (place / "tokenizer.json").is_file()), None)
    files = ["config.json"] * smolvla + ["tokenizer.json"] * (own is None)
    if own is not None and not files:
        return read_tokenizer(own), {}
    name = named or (read.fields.get("vlm_model_name", "") if smolvla else PALIGEMMA)
    try:
        folder = hub.download(str(name), files) if hub.is_repo_id(name) else Path(name)
        found = {file: (folder / file).is_file() for file in files}
        if not all(found.values()):
            raise FileNotFoundError(f"no {' and '.join(file for file in files if not found[file])} in {folder}")
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"{read.folder} does not hold its vision-language model's {' and '.join(files)}, nor could {name} be read "
            f"({error}): backbone= a folder with them"
        ) from error
    described = read_json(folder, "config.json") if smolvla else {}
    wanted = FLOW_FAMILIES[read.kind].backbone
    if smolvla and described.get("model_type") != wanted:
        raise ValueError(f"{folder} holds a {described.get('model_type')!r}, {read.kind} stands on a {wanted}")
    return read_tokenizer(own or folder), described


def _renamed(read: LeRobotFolder, dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
    """Weights by the names of :class:`~worldenv_trl.policies.flow_network.FlowNetwork`; its towers' in ``dtype``."""
    tensors = {}
    for old, tensor in read.tensors():
        name = _name(old)
        if name is not None:
            tower = name.startswith(("backbone.", "expert."))
            tensors[name] = tensor.to(device, dtype if tower else torch.float32)
    return _untied(tensors)


def _shapes(read: LeRobotFolder) -> dict[str, Any]:
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


def _network(config: FlowConfig, tokenizer: Tokenizer, read: LeRobotFolder, device: torch.device) -> FlowNetwork:
    from transformers.initialization import no_init_weights

    if device.type == "meta":
        with torch.device("meta"):
            return make_network(config, tokenizer)
    with no_init_weights():  # billions of random numbers take minutes
        network = make_network(config, tokenizer)
    state, wanted = _renamed(read, getattr(torch, config.dtype), device), network.state_dict()
    prefix = (
        "backbone.model.text_model.layers." if config.kind == "smolvla" else "backbone.model.language_model.layers."
    )
    # Layers of the language model that were never used, and what is behind the last one's keys and values.
    last = config.backbone["text_config"]["num_hidden_layers"] - 1
    spare = [name for name in state if name not in wanted and name.startswith(prefix)]
    kept = {name: tensor for name, tensor in state.items() if name not in spare or int(name.split(".")[4]) < last}
    missing, unknown = sorted(set(wanted) - set(kept)), sorted(set(kept) - set(wanted))
    wrong = [name for name in wanted if name in kept and wanted[name].shape != kept[name].shape]
    if missing or unknown or wrong:
        found = [f"{len(missing)} tensors are missing ({', '.join(missing[:2])})"] if missing else []
        found += [f"{len(unknown)} are unknown ({', '.join(unknown[:2])})"] if unknown else []
        found += [f"{name} is {list(kept[name].shape)}, not {list(wanted[name].shape)}" for name in wrong[:1]]
        raise ValueError(f"{read.folder} does not hold the network of its config: {'; '.join(found)}")
    network.load_state_dict({name: tensor.to(wanted[name].dtype) for name, tensor in kept.items()}, assign=True)
    return network


@torch.no_grad()
def _set_statistics(policy: FlowPolicy, state: Affine, action: Affine, half_range: Tensor) -> None:
    policy.state_center.copy_(state.center)
    policy.state_gain.copy_(state.gain)
    policy.action_center.copy_(action.center)
    policy.action_gain.copy_(action.gain)
    policy.action_range.copy_(half_range.clamp(min=0.005, max=1.0))
