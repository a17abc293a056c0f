"""Pretrained weights from a local folder of diffusers: a VAE, a video UNet and an image encoder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import safetensors.torch
import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from worldenv_trl.world_models.diffusion_world_model import DiffusionWorldModel

__all__ = ["load_diffusers"]

_FIRST = "conv_in.weight"


def load_diffusers(model: DiffusionWorldModel, folder: str | Path) -> list[str]:
    """Copies weights from ``folder/vae``, ``folder/unet`` and ``folder/image_encoder`` into the model, what is there.

    The model's sizes must be those of the folder: ``DiffusionWorldModelConfig.sizes_of(folder)`` are. A UNet that was
    made for fewer channels (Stable Video Diffusion's: noisy latents and an image's) learns the others from zero: what
    it paints is at first what it painted before.

    Returns:
        The parts that were loaded.

    Raises:
        FileNotFoundError: if there is none of them, or a part's ``*.safetensors`` are missing.
        ValueError: for weights of other shapes or names, or that are only there as pickles.
    """
    folder, loaded = Path(folder), []
    parts: dict[str, Any] = {"vae": model.vae, "unet": model.unet.net, "image_encoder": model.context.encoder}
    found = {name: part for name, part in parts.items() if (folder / name / "config.json").exists()}
    if not found:
        raise FileNotFoundError(f"no vae, unet or image_encoder in {folder}: name a folder in the layout of diffusers")
    read = {name: _weights(folder / name) for name in found}
    for name, part in found.items():
        own, weights = part.state_dict(), read[name]
        if name == "unet":
            weights = _widened(weights, own)
        if name == "image_encoder":
            weights = _tower(weights, own)
        _check(folder / name, weights, own)
        part.load_state_dict(weights)
        loaded.append(name)
    return loaded


def _weights(folder: Path) -> dict[str, Tensor]:
    files = sorted(folder.glob("*.safetensors"))
    plain = [path for path in files if ".fp16." not in path.name]
    if not files:
        pickled = sorted(path.name for path in folder.glob("*.bin"))
        if pickled:
            raise ValueError(
                f"{folder} holds its weights as a pickle, {pickled[0]}, which may run code when read: convert it where "
                "you trust it, with from_pretrained(...) and save_pretrained(...) of its class"
            )
        raise FileNotFoundError(f"no *.safetensors in {folder}: copy the weights there")
    out: dict[str, Tensor] = {}
    for path in plain or files:
        try:
            out |= safetensors.torch.load_file(path)
        except safetensors.SafetensorError as error:
            raise ValueError(f"{path} is truncated or corrupt ({error}): copy it again") from error
    return out


def _widened(weights: dict[str, Tensor], own: dict[str, Tensor]) -> dict[str, Tensor]:
    """The first convolution with zeros for the channels that the pretrained one did not have."""
    first, wanted = weights.get(_FIRST), own[_FIRST]
    if first is None or first.shape[1] >= wanted.shape[1]:
        return weights
    return weights | {_FIRST: nn.functional.pad(first, (0, 0, 0, 0, 0, wanted.shape[1] - first.shape[1]))}


def _tower(weights: dict[str, Tensor], own: dict[str, Tensor]) -> dict[str, Tensor]:
    """The vision tower alone, without a projection to text; versions of transformers differ in its prefix."""
    prefix = "vision_model."
    bare = {name.removeprefix(prefix): value for name, value in weights.items()}
    known = {name: bare.get(name.removeprefix(prefix)) for name in own}
    return {name: value for name, value in known.items() if value is not None}


def _check(folder: Path, weights: dict[str, Tensor], own: dict[str, Tensor]) -> None:
    for name in sorted(own.keys() | weights.keys()):
        if name.endswith("position_ids"):
            continue
        here, there = (state.get(name, torch.empty(0)) for state in (own, weights))
        if here.shape != there.shape:
            raise ValueError(
                f"{folder}: {name} is {list(there.shape) if name in weights else 'missing'}, the model's is "
                f"{list(here.shape) if name in own else 'none'}: build the model with "
                "DiffusionWorldModelConfig.sizes_of(folder)"
            )
