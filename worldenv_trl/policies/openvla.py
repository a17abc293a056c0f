"""Released checkpoints of OpenVLA as an :class:`~worldenv_trl.policies.HFTokenPolicy`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from worldenv_trl.keys import ACTION_DIM
from worldenv_trl.policies.hf_files import check_kind, check_weights, local_folder, read_json, read_tokenizer
from worldenv_trl.policies.hf_tokens import HFTokenConfig, HFTokenPolicy
from worldenv_trl.policies.openvla_files import (
    EMPTY_ID,
    LANGUAGE_HEAD,
    check_towers,
    choose_statistics,
    read_prismatic,
)

__all__ = ["load_openvla"]

STATISTICS_NAME = "dataset_statistics.json"


def load_openvla(
    folder: str | os.PathLike,
    *,
    statistics: str | None = None,
    cameras: Sequence[str] = ("agentview",),
    num_images: int = 1,
    device: str | torch.device = "cpu",
    **settings: Any,
) -> HFTokenPolicy:
    """The policy of a folder in the layout of ``openvla/openvla-7b`` and its fine-tuned checkpoints.

    All of it is the checkpoint's: backbone, the rows of the language head that stand for actions, bins and statistics.
    Actions come out in this package's convention: the checkpoint's gripper, 0 closed and 1 open, becomes +1 closed and
    -1 open; position and rotation are in the units of its data set, which are ours for LIBERO's alone. Where the
    reference takes the likeliest token of the whole vocabulary, only action tokens can be drawn. Images must be as
    LIBERO's data set shows them to the checkpoint: ``mirror=True`` makes them of upright ones, ``rotation=180`` of the
    simulator's raw ones. Checkpoints that
    were trained without random crops need ``crop_area=1.0``.

    Args:
        folder: with ``config.json``, the model's safetensors, ``tokenizer.json`` and ``dataset_statistics.json``, in
            whose stead ``norm_stats`` of ``config.json`` are read; or ``owner/name`` of a repository of the Hub that
            holds these.

    Keyword Args:
        statistics: key of the statistics; the only one when None.
        cameras: that it looks through.
        num_images: how many cameras the checkpoint was trained with; the files do not tell. The released ones: 1.
        device: of the parameters.
        settings: other fields of :class:`~worldenv_trl.policies.HFTokenConfig`; ``dtype`` is bfloat16, ``lora_rank`` 32
            and ``chunk_length`` 1, with which it was trained, unless they say otherwise.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: for pickled weights, a statistics key that is not there, another number of cameras, a tokenizer
            without action tokens, or a checkpoint of another architecture.
    """
    if len(cameras) != num_images:
        raise ValueError(
            f"the checkpoint was trained with {num_images} camera{'s' * (num_images != 1)}, got {len(cameras)} "
            f"({', '.join(cameras)}): name {num_images}, or pass num_images={len(cameras)} if it was trained with that "
            "many"
        )
    folder = local_folder(folder)
    described = read_json(folder, "config.json")
    check_kind(described, folder, "openvla")
    check_towers(described, folder)
    if any(folder.glob("action_head--*")):
        raise ValueError(f"{folder} holds OpenVLA-OFT's heads and does not act by tokens: load_openvla_oft reads it")
    path = folder / STATISTICS_NAME
    known = described.get("norm_stats")
    if path.is_file() or not known:
        known = read_json(folder, STATISTICS_NAME)
    else:
        path = folder / "config.json"
    bounds = choose_statistics(known, statistics, path, {"action": ACTION_DIM})["action"]
    weights, tokenizer = check_weights(folder), read_tokenizer(folder)

    settings = {"dtype": "bfloat16"} | settings
    dtype = getattr(torch, settings["dtype"])
    backbone, model, kept = read_prismatic(weights, described, dtype, device, keep=[LANGUAGE_HEAD])
    if LANGUAGE_HEAD not in kept:
        raise ValueError(f"{folder} lacks {LANGUAGE_HEAD}, which reads the action tokens out: fetch all its files")
    trained: dict[str, Any] = {
        "backbone": backbone.to_dict(),
        "cameras": tuple(cameras),
        "chunk_length": 1,
        "fixed_statistics": True,
        "resolution": backbone.image_size,
        "image_mean": (0.0, 0.0, 0.0),  # the towers have their own
        "image_std": (1.0, 1.0, 1.0),
        "prompt_end": (EMPTY_ID,),
        "num_bins": int(described.get("n_action_bins", 256)),
        # The vocabulary was padded behind the tokenizer's own tokens, the last of which stand for actions.
        "action_token_end": backbone.text_config.vocab_size - int(described.get("pad_to_multiple_of", 64)),
    }
    policy = HFTokenPolicy(HFTokenConfig(**(trained | settings)), tokenizer, model)
    policy.take_output_embeddings(kept[LANGUAGE_HEAD])
    _set_bounds(policy, bounds)
    return policy.to(device)


@torch.no_grad()
def _set_bounds(policy: HFTokenPolicy, bounds: Mapping[str, Any]) -> None:
    low, high = (torch.tensor(bounds[name], dtype=torch.float64) for name in ("q01", "q99"))
    scaled = torch.tensor(bounds.get("mask", [True] * ACTION_DIM))
    low, high = torch.where(scaled, low, -1.0), torch.where(scaled, high, 1.0)
    low[-1], high[-1] = 1 - 2 * low[-1], 1 - 2 * high[-1]  # its gripper is 1 open and 0 closed
    policy.action_tokenizer.set_bounds(low, high)
    policy.action_range.copy_(((high - low).abs() / 2).clamp(max=1.0))
