"""Files of OpenVLA's checkpoints, with tokens or OpenVLA-OFT's heads: backbone and statistics."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import safetensors
import torch
from torch import Tensor

from worldenv_trl.policies.prismatic import PrismaticConfig, PrismaticModel, dinosiglip_towers

__all__ = ["EMPTY_ID", "LANGUAGE_HEAD", "check_towers", "choose_statistics", "read_prismatic", "read_tensors"]

EMPTY_ID = 29871  # an empty piece behind "Out:", as Llama's tokenizer once gave it
LANGUAGE_HEAD = "language_model.lm_head.weight"
DINO, SIGLIP = "vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"
NUM_HEADS = 16  # of both towers; shapes of weights do not tell


def check_towers(described: Mapping[str, Any], folder: Path) -> None:
    """Raises ``ValueError`` for a ``config.json`` with other vision towers than those that are known."""
    if described.get("timm_model_ids", [DINO, SIGLIP]) != [DINO, SIGLIP]:
        raise ValueError(
            f"{folder / 'config.json'} describes an openvla with {described['timm_model_ids']}: only the one with "
            f"{DINO} and {SIGLIP} is known"
        )


def choose_statistics(
    known: Mapping[str, Any], key: str | None, path: Path, sizes: Mapping[str, int]
) -> Mapping[str, Any]:
    """The statistics of one data set.

    Args:
        known: by data set.
        key: of the data set; the only one when None.
        path: of the file that they were read from.
        sizes: how many numbers the bounds of each part must hold, of ``action`` and ``proprio``.

    Raises:
        ValueError: if there are none of that key, or others than wanted.
    """
    if key is None and len(known) == 1:
        key = next(iter(known))
    if key is None or key not in known:
        said = "statistics must be named" if key is None else f"there are no statistics {key!r}"
        raise ValueError(f"{said} in {path}: pass statistics= one of {', '.join(known)}")
    for part, size in sizes.items():
        for bound in ("q01", "q99"):
            values = known[key].get(part, {}).get(bound, ())
            if len(values) != size:
                raise ValueError(
                    f"{path}: {key}.{part}.{bound} must hold {size} numbers, "
                    f"got {len(values)}: take the file that belongs to this checkpoint"
                )
    return known[key]


def read_prismatic(
    files: Sequence[Path],
    described: Mapping[str, Any],
    dtype: torch.dtype,
    device: str | torch.device,
    keep: Sequence[str] = (),
) -> tuple[PrismaticConfig, PrismaticModel, dict[str, Tensor]]:
    """The backbone of a checkpoint, and what else was asked for.

    Args:
        files: safetensors of the whole model.
        described: its ``config.json``.
        dtype, device: of the weights.
        keep: names of further tensors, as in the files.

    Raises:
        ValueError: if a file is damaged, or it is another backbone.
    """
    kept: dict[str, Tensor] = {}
    state = {name: tensor.to(device, dtype) for name, tensor in _backbone_tensors(files, keep, kept)}
    side = int(described["image_sizes"][0])
    config = PrismaticConfig(
        {"model_type": "llama", **described["text_config"]},
        {"image_size": side, "towers": [_tower(state, index) for index in range(2)]},
    )
    return config, _model(config, state, dtype), kept


def read_tensors(files: Sequence[Path]) -> Iterator[tuple[str, Tensor]]:
    """Names and tensors of safetensors files.

    Raises:
        ValueError: if one is damaged.
    """
    for path in files:
        try:
            with safetensors.safe_open(path, framework="pt") as opened:
                for name in opened.keys():  # noqa: SIM118 (it is no mapping)
                    yield name, opened.get_tensor(name)
        except safetensors.SafetensorError as error:
            raise ValueError(f"{path} is truncated or corrupt ({error}): fetch it again") from error


def _backbone_tensors(
    files: Sequence[Path], keep: Sequence[str], kept: dict[str, Tensor]
) -> Iterator[tuple[str, Tensor]]:
    renamed = (
        (r"^vision_backbone\.featurizer\.", "towers.0."),
        (r"^vision_backbone\.fused_featurizer\.", "towers.1."),
        (r"^language_model\.model\.", "language_model."),
        (r"\.gamma$", ".scale_factor"),
    )
    unused = re.compile(
        r"^language_model\.lm_head\.|^towers\.\d\.(norm|fc_norm|attn_pool|head)\.|rotary_emb\.inv_freq$"
    )
    for name, tensor in read_tensors(files):
        if name in keep:
            kept[name] = tensor
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
