"""What the loop is made of. To swap a part, pass another :class:`Parts`; no recipe changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from torch import nn

from config import WorldEnvConfig
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.language import split_words
from worldenv_trl.policies import OFTConfig, OFTPolicy, Policy
from worldenv_trl.pretrained import OtherClassError
from worldenv_trl.reflectors import (
    CompactLessons,
    CompactReflector,
    CompactReflectorConfig,
    DualReflector,
    DualReflectorConfig,
    PathLessons,
    PathReflectorConfig,
    Reflector,
)
from worldenv_trl.robot import Camera
from worldenv_trl.scenes import load_task
from worldenv_trl.vision import load_vision
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig, WorldModel

PROPRIO = "commanded"  # the same in physics and imagination, so the policy meets no gap between them

Kind = TypeVar("Kind", bound=nn.Module)


@dataclass(frozen=True)
class Part(Generic[Kind]):
    """How one learned part is made, untrained, and loaded again from what its ``save_pretrained`` wrote."""

    make: Callable[[WorldEnvConfig], Kind]
    load: Callable[[Path], Kind]
    outline: Callable[[WorldEnvConfig], Kind] | None = None
    """What ``make`` makes, on the meta device and without reading weights, where making it takes long."""
    classes: tuple[str, ...] = ()
    """Names of the classes that ``load`` knows, where it is not the ``from_pretrained`` of one of them."""

    @property
    def known(self) -> tuple[str, ...]:
        """Names of the classes that can be loaded; empty where that is not known before."""
        owner = getattr(self.load, "__self__", None)
        return self.classes or ((owner.__name__,) if isinstance(owner, type) else ())


@dataclass(frozen=True)
class Parts:
    """The learned parts, and the arm's kinematics."""

    policy: Part[Policy]
    world_model: Part[WorldModel]
    reflector: Part[Reflector]
    kinematics: Callable[[], ForwardKinematics] = ForwardKinematics


def misfits(config: WorldEnvConfig, part: nn.Module) -> list[str]:
    """What a part was made for that the run has otherwise, a line each, with the setting that helps."""
    seen: Any = part
    lines, missing = [], [camera for camera in seen.cameras if camera not in config.cameras]
    if missing:
        lines.append(
            f"it looks through {', '.join(seen.cameras)}, the run's cameras are {', '.join(config.cameras)}: "
            f"--cameras {' '.join(dict.fromkeys((*config.cameras, *missing)))}"
        )
    if seen.image_size not in (None, config.image_size):
        lines.append(
            f"its images are of {seen.image_size} px, the run's of {config.image_size}: --image-size {seen.image_size}"
        )
    length = getattr(seen, "chunk_length", config.chunk_length)
    if length != config.chunk_length:
        lines.append(
            f"chunk lengths differ, its is {length}, the run's {config.chunk_length}: --chunk-length {length}, with "
            "--max-steps a multiple of it"
        )
    if getattr(seen, "proprio", PROPRIO) != PROPRIO:
        lines.append(f"it was made for {seen.proprio} proprioception, the run's is {PROPRIO}")
    return lines


def check_fits(config: WorldEnvConfig, part: nn.Module) -> None:
    """Raises ``ValueError`` with the first of the :func:`misfits`."""
    for line in misfits(config, part):
        raise ValueError(f"{type(part).__name__}: {line}")


def instructions(config: WorldEnvConfig) -> tuple[str, ...]:
    """What the tasks ask for, in their order."""
    return tuple(load_task(task).language for task in config.tasks)


def cameras_of(config: WorldEnvConfig) -> dict[str, dict[str, Camera]]:
    """Where each of the run's cameras stands, by its name and the instruction of the scene."""
    tasks = [load_task(task) for task in config.tasks]
    return {name: {task.language: task.camera(name) for task in tasks} for name in config.cameras}


def make_policy(config: WorldEnvConfig) -> OFTPolicy:
    settings = config.sft
    policy = OFTPolicy(
        OFTConfig(
            instructions=instructions(config),
            cameras=settings.cameras or config.cameras,
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            proprio=PROPRIO,
            dim=settings.dim,
            depth=settings.depth,
            vision_blocks=settings.vision_blocks,
            max_words=max([16, *(len(split_words(text)) for text in instructions(config))]),
        )
    )
    if settings.vision_blocks:
        load_vision(policy, config.vision_weights)
    return policy


def make_world_model(config: WorldEnvConfig) -> VideoWorldModel:
    settings = config.world_model
    sizes: dict[str, Any] = {"image_size": config.image_size, "chunk_length": config.chunk_length}
    return VideoWorldModel(
        VideoWorldModelConfig.for_cameras(
            cameras_of(config),
            patch=settings.patch,
            memory_stride=min(4, config.chunk_length),
            width=settings.width,
            num_denoise_steps=settings.denoise_steps,
            deterministic=settings.deterministic,
            unroll_prob=settings.unroll_prob,
            **sizes,
        )
    )


def make_reflector(config: WorldEnvConfig) -> CompactReflector | DualReflector:
    settings = config.reflector
    video = CompactReflectorConfig(
        instructions=instructions(config),
        cameras=config.cameras,
        image_size=config.image_size,
        vision_blocks=settings.vision_blocks,
    )
    lessons = CompactLessons(
        encoder_frames=settings.encoder_frames,
        prefixes=settings.prefixes,
        batch_size=settings.batch_size,
        lr=settings.lr,
    )
    reflector: CompactReflector | DualReflector = CompactReflector(video, lessons)
    if settings.path_epochs:
        cameras = {
            name: views
            for name, views in cameras_of(config).items()
            if all(camera.mount == "world" for camera in views.values())
        }
        if not cameras:
            raise ValueError(
                "reflector.path_epochs needs a camera that is fixed in the world, got cameras "
                f"{', '.join(config.cameras)}: add agentview, or set it to 0"
            )
        path = PathReflectorConfig.for_cameras(cameras, image_size=config.image_size)
        reflector = DualReflector(
            DualReflectorConfig(video, path),
            lessons,
            PathLessons(epochs=settings.path_epochs, place_epochs=settings.path_epochs / 2, lr=settings.lr),
        )
    if settings.vision_blocks:
        load_vision(reflector, config.vision_weights)
    return reflector


def load_reflector(path: Path) -> CompactReflector | DualReflector:
    try:
        return CompactReflector.from_pretrained(path)
    except OtherClassError as error:
        try:
            return DualReflector.from_pretrained(path)
        except OtherClassError:
            raise error from None


COMPACT = Parts(
    policy=Part(make_policy, OFTPolicy.from_pretrained),
    world_model=Part(make_world_model, VideoWorldModel.from_pretrained),
    reflector=Part(make_reflector, load_reflector, classes=(CompactReflector.__name__, DualReflector.__name__)),
)
