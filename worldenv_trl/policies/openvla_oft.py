"""Released checkpoints of OpenVLA-OFT as an :class:`~worldenv_trl.policies.HFPolicy`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import safetensors
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
from worldenv_trl.policies.prismatic import PrismaticConfig, PrismaticModel, dinosiglip_towers
from worldenv_trl.weight_files import convert_command

__all__ = ["load_openvla_oft"]

STOP_ID = 2  # </s>, which stood behind the actions in training
EMPTY_ID = 29871  # an empty piece behind "Out:", as Llama's tokenizer once gave it
DINO, SIGLIP = "vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"
NUM_HEADS = 16  # of both towers; shapes of weights do not tell


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
    if described.get("timm_model_ids", [DINO, SIGLIP]) != [DINO, SIGLIP]:
        raise ValueError(
            f"{folder / 'config.json'} describes an openvla with {described['timm_model_ids']}: only the one with "
            f"{DINO} and {SIGLIP} is known"
        )
    bounds = _statistics(folder, statistics)
    weights, tokenizer = check_weights(folder), read_tokenizer(folder)
    parts = {name: _component(folder, name) for name in ("action_head", "proprio_projector")}
    weights = [path for path in weights if "--" not in path.name]

    settings = {"dtype": "bfloat16"} | settings
    dtype = getattr(torch, settings["dtype"])
    state = {name: tensor.to(device, dtype) for name, tensor in _backbone_tensors(weights)}
    side = int(described["image_sizes"][0])
    backbone = PrismaticConfig(
        {"model_type": "llama", **described["text_config"]},
        {"image_size": side, "towers": [_tower(state, index) for index in range(2)]},
    )
    head = parts["action_head"]
    blocks = {name.split(".")[1] for name in head if name.startswith("blocks.")}
    trained: dict[str, Any] = {
        "backbone": backbone.to_dict(),
        "cameras": tuple(cameras),
        "chunk_length": 8,
        "proprio": "measured",
        "proprio_format": "libero",
        "fixed_statistics": True,
        "resolution": side,
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
    policy = HFPolicy(config, tokenizer, _model(backbone, state, dtype))
    _load(policy.loc_head, head, folder, "action_head")
    _load(policy.proprio_projector, parts["proprio_projector"], folder, "proprio_projector")
    _set_bounds(policy, bounds)
    return policy.to(device)


def _statistics(folder: Path, key: str | None) -> Mapping[str, Any]:
    known = read_json(folder, "dataset_statistics.json")
    if key is None and len(known) == 1:
        key = next(iter(known))
    if key not in known:
        said = "statistics must be named" if key is None else f"there are no statistics {key!r}"
        raise ValueError(f"{said} in {folder / 'dataset_statistics.json'}: pass statistics= one of {', '.join(known)}")
    for part, size in (("action", 7), ("proprio", 8)):
        for bound in ("q01", "q99"):
            values = known[key].get(part, {}).get(bound, ())
            if len(values) != size:
                raise ValueError(
                    f"{folder / 'dataset_statistics.json'}: {key}.{part}.{bound} must hold {size} numbers, "
                    f"got {len(values)}: take the file that belongs to this checkpoint"
                )
    return known[key]


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
        raise FileNotFoundError(f"{name}--*_checkpoint.safetensors is missing in {folder}")
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
    for key, tensor in _read([found[0]]):
        for pattern, new in renamed:
            key = re.sub(pattern, new, key)
        tensors[key] = tensor.float()
    if name == "action_head" and "linear_in.weight" not in tensors:
        raise ValueError(f"{found[0]} holds no L1 regression head (MLPResNet): diffusion heads are not known")
    return tensors


def _read(files: Sequence[Path]) -> Iterator[tuple[str, Tensor]]:
    for path in files:
        try:
            with safetensors.safe_open(path, framework="pt") as opened:
                for name in opened.keys():  # noqa: SIM118 (it is no mapping)
                    yield name, opened.get_tensor(name)
        except safetensors.SafetensorError as error:
            raise ValueError(f"{path} is truncated or corrupt ({error}): fetch it again") from error


def _backbone_tensors(files: Sequence[Path]) -> Iterator[tuple[str, Tensor]]:
    renamed = (
        (r"^vision_backbone\.featurizer\.", "towers.0."),
        (r"^vision_backbone\.fused_featurizer\.", "towers.1."),
        (r"^language_model\.model\.", "language_model."),
        (r"\.gamma$", ".scale_factor"),
    )
    unused = re.compile(
        r"^language_model\.lm_head\.|^towers\.\d\.(norm|fc_norm|attn_pool|head)\.|rotary_emb\.inv_freq$"
    )
    for name, tensor in _read(files):
        for pattern, new in renamed:
            name = re.sub(pattern, new, name)
        if not unused.search(name):
            yield name, tensor


def _tower(state: Mapping[str, Tensor], index: int) -> dict[str, Any]:
    """Sizes as the weights have them; what sizes do not tell, as ``dinosiglip-vit-so-224px`` has it."""
    prefix = f"towers.{index}."
    blocks = {int(name.split(".")[3]) for name in state if name.startswith(f"{prefix}blocks.")}
    patches = state.get(f"{prefix}patch_embed.proj.weight")
    inner = state.get(f"{prefix}blocks.0.mlp.fc1.weight")
    if patches is None or inner is None:
        which = ("featurizer", "fused_featurizer")[index]
        raise ValueError(
            f"the safetensors do not hold all of vision_backbone.{which}: one of them is missing, or this is no fused "
            "prismatic checkpoint"
        )
    like = dinosiglip_towers()[index]
    registers = state.get(f"{prefix}reg_token")
    return {
        "dim": patches.shape[0],
        "depth": max(blocks),  # the last block is not used
        "num_heads": NUM_HEADS,
        "mlp_dim": inner.shape[0],
        "patch_size": patches.shape[-1],
        "registers": 0 if registers is None else registers.shape[1],
        "class_token": f"{prefix}cls_token" in state,
        "layer_scale": f"{prefix}blocks.0.ls1.scale_factor" in state,
        "mean": like.mean,
        "std": like.std,
    }


def _model(config: PrismaticConfig, state: dict[str, Tensor], dtype: torch.dtype) -> PrismaticModel:
    from accelerate import init_empty_weights

    with init_empty_weights(include_buffers=False):  # seven billion random numbers take minutes
        model = PrismaticModel(config, dtype)
    for index, tower in enumerate(config.towers):
        last = f"towers.{index}.blocks.{tower.depth}."
        state = {name: tensor for name, tensor in state.items() if not name.startswith(last)}
    missing, unexpected = model.load_state_dict(state, strict=False, assign=True)
    if missing or unexpected:
        raise ValueError(
            f"the checkpoint's backbone is another one: {len(missing)} tensors are missing ({', '.join(missing[:2])}), "
            f"{len(unexpected)} unknown ({', '.join(unexpected[:2])})"
        )
    return model


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
