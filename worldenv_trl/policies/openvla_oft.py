"""Released checkpoints of OpenVLA-OFT as an :class:`~worldenv_trl.policies.HFPolicy`."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from worldenv_trl.policies.hf import HFConfig, HFPolicy
from worldenv_trl.policies.hf_files import (
    check_kind,
    check_weights,
    local_folder,
    read_json,
    read_tokenizer,
)
from worldenv_trl.policies.openvla_files import (
    EMPTY_ID,
    check_towers,
    choose_statistics,
    read_prismatic,
    read_tensors,
)
from worldenv_trl.weight_files import convert_command

__all__ = ["load_openvla_oft"]

STOP_ID = 2  # </s>, which stood behind the actions in training


def load_openvla_oft(
    folder: str | os.PathLike,
    *,
    statistics: str | None = None,
    cameras: Sequence[str] = ("agentview", "wrist"),
    num_images: int = 2,
    device: str | torch.device = "cpu",
    **settings: Any,
) -> HFPolicy:
    """The policy of a folder in the layout of ``moojink/openvla-7b-oft-finetuned-libero-*``.

    Backbone, action head, projector of proprioception and statistics are the checkpoint's. The scale head is new, for
    OpenVLA-OFT has none: train it before LOOP. Actions come out in this package's convention: the checkpoint's gripper,
    0 closed and 1 open, becomes +1 closed and -1 open. Images must be as LIBERO's data set shows them to the
    checkpoint: ``mirror=True`` makes them of upright ones, ``rotation=180`` of the simulator's raw ones.

    Args:
        folder: with ``config.json``, the backbone's safetensors, ``action_head--*_checkpoint.safetensors`` and
            ``proprio_projector--*_checkpoint.safetensors`` (released as ``.pt``: a pickle, refused with the command
            that converts it), ``dataset_statistics.json`` and ``tokenizer.json``; or ``owner/name`` of a
            repository of the Hub that holds these.

    Keyword Args:
        statistics: key of ``dataset_statistics.json``; the only one when None.
        cameras: in the order of training: the scene's, then the wrist's.
        num_images: how many cameras the checkpoint was trained with; the files do not tell. LIBERO's: 2.
        device: of the parameters.
        settings: other fields of :class:`~worldenv_trl.policies.HFConfig`; ``dtype`` is bfloat16 and ``lora_rank`` 32
            unless they say otherwise.

    Raises:
        FileNotFoundError: if a file is missing, or there are two of one kind.
        ValueError: for pickled weights, a statistics key that is not there, another number of cameras, or a checkpoint
            of another architecture.
    """
    if len(cameras) != num_images:
        raise ValueError(
            f"the checkpoint was trained with {num_images} cameras, got {len(cameras)} ({', '.join(cameras)}): name "
            f"{num_images}, or pass num_images={len(cameras)} if it was trained with that many"
        )
    folder = local_folder(folder)
    described = read_json(folder, "config.json")
    check_kind(described, folder, "openvla")
    check_towers(described, folder)
    known = read_json(folder, "dataset_statistics.json")
    bounds = choose_statistics(known, statistics, folder / "dataset_statistics.json", {"action": 7, "proprio": 8})
    weights, tokenizer = check_weights(folder), read_tokenizer(folder)
    parts = {name: _component(folder, name) for name in ("action_head", "proprio_projector")}
    weights = [path for path in weights if "--" not in path.name]

    settings = {"dtype": "bfloat16"} | settings
    dtype = getattr(torch, settings["dtype"])
    backbone, model, _ = read_prismatic(weights, described, dtype, device)
    head = parts["action_head"]
    blocks = {name.split(".")[1] for name in head if name.startswith("blocks.")}
    trained: dict[str, Any] = {
        "backbone": backbone.to_dict(),
        "cameras": tuple(cameras),
        "chunk_length": 8,
        "proprio": "measured",
        "proprio_format": "libero",
        "fixed_statistics": True,
        "resolution": backbone.image_size,
        "image_mean": (0.0, 0.0, 0.0),  # the towers have their own
        "image_std": (1.0, 1.0, 1.0),
        "attention": "full",
        "stop_id": STOP_ID,
        "readout_shift": 1,
        "prompt_end": (EMPTY_ID,),
        "head_dim": head["linear_in.weight"].shape[0],
        "head_blocks": len(blocks),
    }
    config = HFConfig(**(trained | settings))
    policy = HFPolicy(config, tokenizer, model)
    _load(policy.loc_head, head, folder, "action_head")
    _load(policy.proprio_projector, parts["proprio_projector"], folder, "proprio_projector")
    _set_bounds(policy, bounds)
    return policy.to(device)


def _component(folder: Path, name: str) -> dict[str, Tensor]:
    """Weights of a head, renamed to this package's names."""
    found = sorted(folder.glob(f"{name}--*.safetensors"))
    if len(found) > 1:
        raise FileNotFoundError(f"{folder} holds {len(found)} files {name}--*.safetensors: leave the one that counts")
    if not found:
        pickled = sorted(folder.glob(f"{name}--*.pt"))
        if pickled:
            raise ValueError(
                f"{pickled[0]} is a pickle, which can run any code when read. If you trust where it is from, convert "
                f"it once: {convert_command(pickled[0])}"
            )
        others = "; a checkpoint without it acts by tokens: load_openvla" if name == "action_head" else ""
        raise FileNotFoundError(f"{name}--*_checkpoint.safetensors is missing in {folder}{others}")
    renamed = (
        (r"^module\.", ""),  # of a data-parallel training
        (r"^model\.", ""),
        (r"^layer_norm1\.", "norm_in."),
        (r"^layer_norm2\.", "norm_out."),
        (r"^mlp_resnet_blocks\.(\d+)\.ffn\.", r"blocks.\1."),
        (r"^fc1\.", "linear_in." if name == "action_head" else "0."),
        (r"^fc2\.", "linear_out." if name == "action_head" else "2."),
    )
    tensors = {}
    for key, tensor in read_tensors([found[0]]):
        for pattern, new in renamed:
            key = re.sub(pattern, new, key)
        tensors[key] = tensor.float()
    if name == "action_head" and "linear_in.weight" not in tensors:
        raise ValueError(f"{found[0]} holds no L1 regression head (MLPResNet): diffusion heads are not known")
    return tensors


def _load(module: torch.nn.Module, tensors: Mapping[str, Tensor], folder: Path, name: str) -> None:
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines()]
        raise ValueError(f"{folder}/{name}--* does not fit its backbone: {' '.join(lines[1:3])}") from error


@torch.no_grad()
def _set_bounds(policy: HFPolicy, bounds: Mapping[str, Any]) -> None:
    low, high = (torch.tensor(bounds["proprio"][name]) for name in ("q01", "q99"))
    policy.state_low.copy_(low)
    policy.state_high.copy_(high)
    low, high = (torch.tensor(bounds["action"][name], dtype=torch.float64) for name in ("q01", "q99"))
    gain = (high - low + 1e-8) / 2
    policy.action_gain.copy_(gain)
    policy.action_center.copy_(low + gain)
    policy.action_gain[-1], policy.action_center[-1] = -2.0, 1.0  # its gripper is 1 open and 0 closed, and not scaled
    policy.action_range.copy_(policy.action_gain.abs().clamp(max=1.0))
