"""Reading folders of pretrained vision-language models: safetensors alone, and one clear line for what is missing."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from worldenv_trl import hub
from worldenv_trl.weight_files import convert_command

if TYPE_CHECKING:
    from tokenizers import Tokenizer
    from transformers import PreTrainedModel

__all__ = ["check_kind", "check_weights", "local_folder", "read_backbone", "read_json", "read_tokenizer"]


def local_folder(name: str | os.PathLike, revision: str | None = None) -> Path:
    """A folder, or that of a Hub repository's files in the cache on this machine, brought there if need be.

    Raises:
        FileNotFoundError: if the repository cannot be had.
    """
    if hub.is_repo_id(name):
        return hub.download(str(name), ["*.json", "*.safetensors", "*.pt"], revision=revision)
    return Path(name)


def check_kind(fields: dict[str, Any], folder: Path, wanted: str) -> None:
    """Refuses a config of another kind of checkpoint, with what reads that kind.

    Args:
        fields: of ``config.json``.
        folder: where it is.
        wanted: ``backbone``, transformers' own, ``openvla`` or ``lerobot``.

    Raises:
        ValueError: for another kind.
    """
    if "class" in fields and "config" in fields:
        found, reader = f"a {fields['class']} of worldenv_trl", f"{fields['class']}.from_pretrained"
    elif "model_type" not in fields and {"type", "input_features"} & set(fields):
        if wanted == "lerobot":
            return
        found, reader = f"a LeRobot policy of type {fields.get('type')!r}", "load_lerobot"
    elif fields.get("model_type") == "openvla" and wanted != "openvla":
        found, reader = "an OpenVLA checkpoint", "load_openvla_oft, or load_openvla where it acts by tokens"
    elif fields.get("model_type") != "openvla" and wanted != "backbone":
        found, reader = f"a model of type {fields.get('model_type')!r}", "HFPolicy.from_backbone"
    else:
        return
    raise ValueError(f"{folder} holds {found}: what reads it is {reader}")


def read_backbone(
    folder: str | os.PathLike, dtype: torch.dtype, device: str | torch.device
) -> tuple[dict[str, Any], Tokenizer, PreTrainedModel]:
    """What ``from_backbone`` needs of a folder: fields of its config, tokenizer and the whole model, with its language
    head.

    On the device ``meta`` no weights are read.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if the weights are pickled, or the config is of no known family.
    """
    from transformers import AutoModelForImageTextToText

    from worldenv_trl.policies.hf_backbone import backbone_config

    folder = local_folder(folder)
    described = read_json(folder, "config.json")
    check_kind(described, folder, "backbone")
    config = backbone_config(described)
    check_weights(folder)
    fields: dict[str, Any] = {"backbone": config.to_dict()}
    if (folder / "preprocessor_config.json").exists():
        images = read_json(folder, "preprocessor_config.json")
        fields |= {name: tuple(images[name]) for name in ("image_mean", "image_std") if name in images}
    tokenizer = read_tokenizer(folder)
    with torch.device(device):
        if torch.device(device).type == "meta":
            return fields, tokenizer, AutoModelForImageTextToText.from_config(config, dtype=dtype)
        model = AutoModelForImageTextToText.from_pretrained(folder, dtype=dtype, local_files_only=True)
    return fields, tokenizer, model


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """A JSON file of a checkpoint folder.

    Raises:
        FileNotFoundError: if it is missing.
        ValueError: if it is no JSON object.
    """
    path = folder / name
    if not path.is_file():
        found = ", ".join(sorted(each.name for each in folder.iterdir())) if folder.is_dir() else "no such folder"
        raise FileNotFoundError(f"{path} is missing, which a checkpoint folder must hold; there is: {found}")
    try:
        fields = json.loads(path.read_text())
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is no JSON ({error}): fetch it again") from error
    if not isinstance(fields, dict):
        raise ValueError(f"{path} must hold a JSON object, got {type(fields).__name__}: fetch it again")
    return fields


def read_tokenizer(folder: Path) -> Tokenizer:
    """Of a folder's ``tokenizer.json``.

    Raises:
        FileNotFoundError: if it is missing; how to make it from older files is said.
        ValueError: if it is none.
    """
    path = folder / "tokenizer.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is missing: write it with transformers' "
            f"AutoTokenizer.from_pretrained({str(folder)!r}).save_pretrained({str(folder)!r})"
        )
    return tokenizer_of(path)


def tokenizer_of(path: Path) -> Tokenizer:
    """Of a file of the library ``tokenizers``.

    Raises:
        ValueError: naming the file, if it holds something else.
    """
    from tokenizers import Tokenizer

    try:
        return Tokenizer.from_file(str(path))
    except Exception as error:  # the library raises nothing more special
        raise ValueError(f"{path} is not a tokenizer of the library tokenizers: {error}") from error


def check_weights(folder: Path, pattern: str = "*.safetensors") -> list[Path]:
    """The safetensors files of a folder, those whose names are like ``pattern``.

    Raises:
        FileNotFoundError: if there are no weights, or a file is missing that their index lists.
        ValueError: if they are pickled: reading them could run any code; the command that converts them is said.
    """
    found = sorted(folder.glob(pattern))
    index = folder / "model.safetensors.index.json"
    if index.is_file():
        listed = sorted(set(read_json(folder, index.name).get("weight_map", {}).values()))
        missing = [name for name in listed if not (folder / name).is_file()]
        if missing:
            raise FileNotFoundError(f"{folder} lacks {', '.join(missing)}, which {index.name} lists: fetch them again")
    pickled = sorted(path.name for pattern in ("*.bin", "*.pt", "*.pth") for path in folder.glob(pattern))
    if found:
        return found
    if pickled:
        raise ValueError(
            f"{folder} holds its weights as pickles alone ({pickled[0]}), which can run any code when read. If you "
            "trust where they are from, convert them once: " + convert_command(folder / pickled[0])
        )
    raise FileNotFoundError(f"{folder} holds no weights: {pattern} is missing")
