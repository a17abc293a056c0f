"""LeRobot's folders: SmolVLA, pi0 and pi0.5 as a :class:`~worldenv_trl.policies.FlowPolicy`, and pi0-FAST."""

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
from worldenv_trl.policies.lerobot_fast import PI0_FAST, load_pi0_fast
from worldenv_trl.policies.lerobot_files import Affine, LeRobotFolder, read_lerobot_folder
from worldenv_trl.policies.lerobot_weights import assign_weights, named_shapes, named_tensors, paligemma_sizes

if TYPE_CHECKING:
    from tokenizers import Tokenizer

    from worldenv_trl.policies.fast import FASTPolicy

__all__ = ["load_lerobot"]

STATE, ACTION = "observation.state", "action"
CAMERAS = ("agentview", "wrist")
DTYPE = "bfloat16"  # of the towers, where nothing else is asked for
PALIGEMMA = "google/paligemma-3b-pt-224"  # whose tokenizer pi0 and pi0.5 read with
_LAST_NORM = re.compile(r"backbone\.model\.(text_model|language_model)\.norm\.")
_NEEDED = ("chunk_size", "max_state_dim", "max_action_dim", "tokenizer_max_length")
# What other robots and other trainings switch on, and is not done here.
_UNKNOWN = ("adapt_to_pi_aloha", "use_relative_actions", "use_visual_memory", "use_proprioceptive_memory")


def load_lerobot(
    folder: str | os.PathLike,
    *,
    cameras: Sequence[str] | None = None,
    image_features: Sequence[str] | None = None,
    backbone: str | os.PathLike | None = None,
    action_tokenizer: str | os.PathLike | None = None,
    device: str | torch.device = "cpu",
    **settings: Any,
) -> FlowPolicy | FASTPolicy:
    """The policy of a folder that LeRobot wrote, of type ``smolvla``, ``pi0``, ``pi05`` or ``pi0_fast``.

    Network and statistics are the checkpoint's; the scale head is new, for a flow has none: train it before LOOP
    (pi0-FAST, a :class:`~worldenv_trl.policies.FASTPolicy`, acts by tokens and needs none). Its
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
        action_tokenizer: folder, or repository, of pi0-FAST's, as :meth:`FASTActionTokenizer.from_pretrained` reads it.
            When None, ``action_tokenizer/`` of the policy's own folder, or what its config names.
        device: of the parameters; on ``meta`` no weights are read.
        settings: other fields of :class:`~worldenv_trl.policies.FlowConfig`, or of
            :class:`~worldenv_trl.policies.FASTConfig`; ``chunk_length`` is the policy's ``n_action_steps``, ``dtype``
            bfloat16 and ``lora_rank`` 32 unless they say otherwise.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: for another kind or type of checkpoint, pickled weights, another number of cameras, a missing
            statistic, features that are not this arm's, or weights that do not fit.
    """
    read = read_lerobot_folder(folder, (*FLOW_FAMILIES, PI0_FAST))
    wanted = tuple(image_features or read.image_features)
    cameras = CAMERAS[: len(wanted)] if cameras is None else tuple(cameras)
    _check(read, cameras, wanted)
    tokenizer, described = _backbone(read, backbone)
    fixed = bool(settings.get("fixed_statistics", True))
    _check_arm(read, fixed)
    if read.kind == PI0_FAST:
        statistics = (read.normalizer(STATE), read.normalizer(ACTION)) if fixed else None
        settings = {"cameras": cameras} | settings
        where, half = torch.device(device), read.half_range(ACTION)
        return load_pi0_fast(read, tokenizer, action_tokenizer, statistics, half, where, settings)
    config = FlowConfig(**(_settings(read, named_shapes(read), described, fixed) | {"cameras": cameras} | settings))
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


def _check_arm(read: LeRobotFolder, fixed: bool) -> None:
    state, action = read.inputs[STATE].shape, read.outputs[ACTION].shape
    if fixed and (action != (ACTION_DIM,) or state not in ((STATE_DIM,), (STATE_DIM + 1,))):
        raise ValueError(
            f"{read.folder} was trained for states {list(state)} and actions {list(action)}, this arm has "
            f"[{STATE_DIM}] (LIBERO's: [{STATE_DIM + 1}]) and [{ACTION_DIM}]: fixed_statistics=False begins with "
            "its weights and normalises by your data"
        )


def _settings(
    read: LeRobotFolder, shapes: Mapping[str, Sequence[int]], described: Mapping[str, Any], fixed: bool
) -> dict[str, Any]:
    fields, layers = read.fields, "expert.layers."
    state = read.inputs[STATE].shape
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
    network = _smolvlm(described, shapes, fields) if read.kind == "smolvla" else paligemma_sizes(read, shapes, side[0])
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


def _network(config: FlowConfig, tokenizer: Tokenizer, read: LeRobotFolder, device: torch.device) -> FlowNetwork:
    from transformers.initialization import no_init_weights

    if device.type == "meta":
        with torch.device("meta"):
            return make_network(config, tokenizer)
    with no_init_weights():  # billions of random numbers take minutes
        network = make_network(config, tokenizer)
    state, wanted = named_tensors(read, getattr(torch, config.dtype), device), network.state_dict()
    prefix = (
        "backbone.model.text_model.layers." if config.kind == "smolvla" else "backbone.model.language_model.layers."
    )
    # Nothing of the flow reads the last norm.
    state = {name: tensor for name, tensor in state.items() if not _LAST_NORM.match(name)}
    # Layers of the language model that were never used, and what is behind the last one's keys and values.
    last = config.backbone["text_config"]["num_hidden_layers"] - 1
    spare = [name for name in state if name not in wanted and name.startswith(prefix)]
    kept = {name: tensor for name, tensor in state.items() if name not in spare or int(name.split(".")[4]) < last}
    assign_weights(network, kept, read)
    return network


@torch.no_grad()
def _set_statistics(policy: FlowPolicy, state: Affine, action: Affine, half_range: Tensor) -> None:
    policy.state_center.copy_(state.center)
    policy.state_gain.copy_(state.gain)
    policy.action_center.copy_(action.center)
    policy.action_gain.copy_(action.gain)
    policy.action_range.copy_(half_range.clamp(min=0.005, max=1.0))
