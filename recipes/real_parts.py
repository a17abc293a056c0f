"""The parts at real size: pretrained ones of the local folders that ``config.real_size`` names."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch

from config import WorldEnvConfig
from libero_files import from_libero
from parts import COMPACT, PROPRIO, Part, Parts, cameras_of, instructions
from worldenv_trl.policies import (
    FASTPolicy,
    FlowPolicy,
    HFPolicy,
    HFTokenPolicy,
    Policy,
    load_lerobot,
    load_openvla,
    load_openvla_oft,
)
from worldenv_trl.policies.hf_files import check_weights, read_json
from worldenv_trl.policies.lerobot_fast import PI0_FAST
from worldenv_trl.reflectors import Reflector, VLMReflector, VLMReflectorConfig
from worldenv_trl.reflectors.video_language_model import VideoLanguageModel
from worldenv_trl.world_models import DiffusionWorldModel, DiffusionWorldModelConfig, WorldModel, load_diffusers

NAMES = ("compact", "real-size")
ACTION_HEADS = ("continuous", "tokens", "fast")


def parts_of(config: WorldEnvConfig) -> Parts:
    """What the setting ``parts`` names.

    Raises:
        ValueError: for another name.
    """
    if config.parts not in NAMES:
        raise ValueError(f"parts must be one of {', '.join(NAMES)}, got {config.parts!r}")
    return REAL_SIZE if config.parts == "real-size" else COMPACT


def make_policy(config: WorldEnvConfig, device: str = "cpu") -> Policy:
    """A checkpoint of OpenVLA-OFT or OpenVLA, LeRobot's of a flow-matching policy, or a vision-language model that
    is to act as OpenVLA-OFT's or OpenVLA's does.

    Raises:
        FileNotFoundError: if the folder lacks a file.
        ValueError: if none is named, or what is in it does not suit the run.
    """
    folder = _named(config, "policy")
    settings = policy_settings(config)
    described = read_json(folder, "config.json")
    if "input_features" in described:
        chosen, whole = config.real_size, described.get("type") == PI0_FAST
        if action_head(config) not in ("continuous", "fast" if whole else "continuous"):
            raise ValueError(
                f"{folder} holds LeRobot's policy, which does not act by such tokens: --real-size.action-head "
                + ("fast" if whole else "continuous")
            )
        settings |= {"backbone": chosen.backbone or None, "mirror": chosen.mirror, "chunk_length": config.chunk_length}
        if whole:
            settings["action_tokenizer"] = chosen.action_tokenizer or None
        return load_lerobot(folder, device=device, **settings)
    openvla = described.get("model_type") == "openvla"
    if action_head(config) == "fast":
        if openvla:
            raise ValueError(
                f"{folder} holds OpenVLA's policy, which does not act by FAST's tokens: another action-head"
            )
        settings |= {"chunk_length": config.chunk_length, "action_tokenizer": config.real_size.action_tokenizer or None}
        return FASTPolicy.from_backbone(folder, device=device, **settings)
    if action_head(config) == "tokens":
        settings["chunk_length"] = config.chunk_length
        if not openvla:
            return HFTokenPolicy.from_backbone(folder, device=device, **settings)
        if len(settings["cameras"]) != 1:
            raise ValueError(
                f"{folder} was trained with 1 camera, got {len(settings['cameras'])} "
                f"({', '.join(settings['cameras'])}): --sft.cameras {settings['cameras'][0]}"
            )
        settings |= {"mirror": True, "fixed_statistics": not from_libero(config)}  # see below
        return load_openvla(folder, statistics=config.real_size.statistics or None, device=device, **settings)
    if not openvla:
        return HFPolicy.from_backbone(folder, device=device, chunk_length=config.chunk_length, **settings)
    if (config.sft.cameras and len(config.sft.cameras) != 2) or len(config.cameras) != 2:
        raise ValueError(
            f"{folder} was trained with 2 cameras, got {len(settings['cameras'])} ({', '.join(settings['cameras'])}): "
            "--cameras agentview wrist, and leave --sft.cameras out"
        )
    # Its images were LIBERO's raw ones turned by 180 degrees: ours, which are upright, mirrored. Its bounds are of
    # LIBERO's world and controller; those of the run's own demonstrations of LIBERO mean the same here.
    settings |= {"mirror": True, "fixed_statistics": not from_libero(config)}
    return load_openvla_oft(folder, statistics=config.real_size.statistics or None, device=device, **settings)


def load_policy(folder: Path) -> Policy:
    """What ``save_pretrained`` of a policy of :func:`make_policy` wrote."""
    written = read_json(folder, "config.json").get("class")
    kinds: tuple[type[HFTokenPolicy] | type[FASTPolicy] | type[FlowPolicy], ...]
    kinds = (HFTokenPolicy, FASTPolicy, FlowPolicy)
    kind = next((kind for kind in kinds if kind.__name__ == written), HFPolicy)
    return kind.from_pretrained(folder)


def action_head(config: WorldEnvConfig) -> str:
    """How the policy is to act.

    Raises:
        ValueError: for a head that is not known.
    """
    head = config.real_size.action_head
    if head not in ACTION_HEADS:
        raise ValueError(f"real_size.action_head must be one of {', '.join(ACTION_HEADS)}, got {head!r}")
    return head


def policy_settings(config: WorldEnvConfig) -> dict[str, Any]:
    """Fields of :class:`~worldenv_trl.policies.HFConfig`, or of its like, that the run decides."""
    return {
        "instructions": instructions(config),
        "cameras": config.sft.cameras or config.cameras,
        "image_size": config.image_size,
        "proprio": PROPRIO,
        "lora_rank": config.post_train.lora_rank,
        "dtype": config.real_size.dtype,
        "gradient_checkpointing": True,
    }


def make_world_model(config: WorldEnvConfig, device: str = "cpu") -> DiffusionWorldModel:
    """EVAC's model, as much of it pretrained as the folder holds.

    Raises:
        FileNotFoundError: if the folder lacks a file.
        ValueError: if none is named, or what is in it does not suit the run.
    """
    folder = _named(config, "world_model")
    sizes = DiffusionWorldModelConfig.sizes_of(folder)
    if device != "meta":
        model = DiffusionWorldModel(world_model_config(config, **sizes))
        load_diffusers(model, folder)
        return model
    for part in sizes:
        check_weights(folder / part)
    return outlined_world_model(config, **sizes)


def outlined_world_model(config: WorldEnvConfig, **sizes: Any) -> DiffusionWorldModel:
    """On the meta device."""
    with torch.device("meta"):
        return DiffusionWorldModel(world_model_config(config, **sizes)).to("meta")  # diffusers makes some on the CPU


def world_model_config(config: WorldEnvConfig, **sizes: Any) -> DiffusionWorldModelConfig:
    """The run's cameras and sizes; ``sizes`` are the network's."""
    return DiffusionWorldModelConfig.for_cameras(
        cameras_of(config),
        image_size=config.image_size,
        chunk_length=config.chunk_length,
        frame_size=config.real_size.frame_size,
        rows_per_call=config.real_size.rows_per_call,
        num_denoise_steps=config.world_model.denoise_steps,
        gradient_checkpointing=True,
        **sizes,
    )


def make_reflector(config: WorldEnvConfig, device: str = "cpu") -> VLMReflector:
    """A reward head on a frozen video language model.

    Raises:
        FileNotFoundError: if the folder lacks a file.
        ValueError: if none is named, or it holds a model of another class.
    """
    settings = reflector_config(config, str(_named(config, "reflector")))
    return VLMReflector(settings, vlm=VideoLanguageModel.load(settings.model, settings.dtype, device)).to(device)


def reflector_config(config: WorldEnvConfig, model: str) -> VLMReflectorConfig:
    settings = config.real_size
    return VLMReflectorConfig(
        model,
        instructions(config),
        camera=config.cameras[0],
        num_frames=settings.num_frames,
        score_every=settings.score_every,
        dtype=settings.dtype,
    )


def _named(config: WorldEnvConfig, part: str) -> Path:
    folder: Path | None = getattr(config.real_size, part)
    option = f"--real-size.{part.replace('_', '-')}"
    if folder is None:
        raise ValueError(f"{option} names no folder: parts=real-size needs one (recipes/README.md, Real sizes)")
    if not folder.is_dir():
        raise FileNotFoundError(f"{option}: there is no folder {folder}")
    return folder


REAL_SIZE = Parts(
    policy=Part[Policy](make_policy, load_policy, partial(make_policy, device="meta")),
    world_model=Part[WorldModel](
        make_world_model, DiffusionWorldModel.from_pretrained, partial(make_world_model, device="meta")
    ),
    reflector=Part[Reflector](make_reflector, VLMReflector.from_pretrained, partial(make_reflector, device="meta")),
)
