"""LeRobot's folders of pi0-FAST as a :class:`~worldenv_trl.policies.FASTPolicy`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from worldenv_trl.policies.fast import FASTConfig, FASTPolicy
from worldenv_trl.policies.fast_tokens import FASTActionTokenizer
from worldenv_trl.policies.hf_backbone import backbone_config, make_model
from worldenv_trl.policies.lerobot_files import Affine, LeRobotFolder
from worldenv_trl.policies.lerobot_weights import assign_weights, named_shapes, named_tensors, paligemma_sizes

if TYPE_CHECKING:
    from tokenizers import Tokenizer

__all__ = ["PI0_FAST", "load_pi0_fast"]

PI0_FAST = "pi0_fast"
ACTION_TOKENIZER = "lerobot/fast-action-tokenizer"
_BACKBONE = "backbone.model."


def load_pi0_fast(
    read: LeRobotFolder,
    tokenizer: Tokenizer,
    action_tokenizer: str | os.PathLike | None,
    statistics: tuple[Affine, Affine] | None,
    half_range: torch.Tensor,
    device: torch.device,
    settings: Mapping[str, Any],
) -> FASTPolicy:
    """The policy of a folder that :func:`~worldenv_trl.policies.load_lerobot` has read.

    Args:
        read: of type ``pi0_fast``.
        tokenizer: PaliGemma's.
        action_tokenizer: folder or Hub id of FAST's; ``action_tokenizer/`` of the policy's own folder, or what its
            config names, when None.
        statistics: normalisation of proprioception and of actions; None leaves it to be fitted.
        half_range: of the actions.
        device: of the parameters.
        settings: fields of :class:`FASTConfig` that the run decides.

    Raises:
        FileNotFoundError: if FAST's tokenizer cannot be had.
        ValueError: for sizes or weights that do not fit.
    """
    fields, shapes = read.fields, named_shapes(read)
    side = fields.get("image_resolution", (224, 224))
    if side[0] != side[1]:
        raise ValueError(f"{read.folder} resizes images to {side}: only squares are known")
    first = tokenizer.token_to_id("<bos>")
    if first is None:
        raise ValueError(f"the tokenizer of {read.folder} has no token '<bos>', which stands before its actions")
    horizon = int(settings.get("horizon", fields["chunk_size"]))
    max_tokens = int(settings.get("max_tokens", 0))
    codec = _action_tokenizer(read, action_tokenizer, horizon, max_tokens)
    told = {
        "backbone": paligemma_sizes(read, shapes, side[0]),
        "chunk_length": fields.get("n_action_steps", fields["chunk_size"]),
        "horizon": horizon,
        "resolution": side[0],
        "prompt_end": (first,),  # a second one, behind the prompt
        "proprio_format": "state" if read.inputs["observation.state"].shape == (7,) else "libero",
        "fast_vocab_size": codec.size,
        "scale": codec.scale,
        "skip_tokens": fields.get("fast_skip_tokens", 128),
        "fixed_statistics": statistics is not None,
        "fixed_tokenizer": True,
        "dtype": "bfloat16",
    }
    config = FASTConfig(**(told | dict(settings)))
    dtype = getattr(torch, config.dtype)
    policy = _with_weights(config, tokenizer, codec, read, dtype, device)
    if statistics is not None:
        _set_statistics(policy, *statistics, half_range)
    return policy.to(device)


def _action_tokenizer(
    read: LeRobotFolder, named: str | os.PathLike | None, horizon: int, max_tokens: int
) -> FASTActionTokenizer:
    own = read.folder / "action_tokenizer"
    place: str | os.PathLike = named or (
        own if own.is_dir() else read.fields.get("action_tokenizer_name", ACTION_TOKENIZER)
    )
    try:
        return FASTActionTokenizer.from_pretrained(place, horizon, max_tokens=max_tokens)
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"{read.folder} does not hold FAST's tokenizer, nor could {place} be read ({error}): "
            "action_tokenizer= a folder with its tokenizer.json and processor_config.json"
        ) from error


def _with_weights(
    config: FASTConfig,
    tokenizer: Tokenizer,
    codec: FASTActionTokenizer,
    read: LeRobotFolder,
    dtype: torch.dtype,
    device: torch.device,
) -> FASTPolicy:
    from transformers.initialization import no_init_weights

    if device.type == "meta":
        with torch.device("meta"):
            return FASTPolicy(config, tokenizer, action_tokenizer=codec)
    with no_init_weights():  # billions of random numbers take minutes
        model = make_model(backbone_config(config.backbone), dtype)
    tensors = {name.removeprefix(_BACKBONE): each for name, each in named_tensors(read, dtype, device).items()}
    assign_weights(model, tensors, read)
    policy = FASTPolicy(config, tokenizer, model, codec)
    policy.take_output_embeddings(tensors["language_model.embed_tokens.weight"])  # tied
    return policy


@torch.no_grad()
def _set_statistics(policy: FASTPolicy, state: Affine, action: Affine, half_range: torch.Tensor) -> None:
    policy.state_low.copy_(state.center - state.gain)
    policy.state_high.copy_(state.center + state.gain)
    policy.action_tokenizer.set_normalization(action.center, action.gain)
    policy.action_range.copy_(half_range.clamp(min=0.005, max=1.0))
