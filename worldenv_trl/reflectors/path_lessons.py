"""What a :class:`PathReflector` is trained on: whole episodes, each by its first frame, its path and its labels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor

from worldenv_trl.devices import device_of
from worldenv_trl.keys import TASK_ID
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.reflectors.base import Lesson

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes
    from worldenv_trl.reflectors.path import PathReflector

__all__ = ["PathLessons"]

_PATH_NOISE = 0.05  # of normalised entries
_LIGHT = 0.1  # standard deviation of a frame's contrast
_EPISODES_AT_ONCE = 64


@dataclass(frozen=True)
class PathLessons:
    """How long a :class:`PathReflector` learns.

    Args:
        steps: batches.
        batch_size: episodes in a batch.
        lr: the highest learning rate.
        weight_decay: of AdamW.

    Raises:
        ValueError: for numbers out of range.
    """

    steps: int = 800
    batch_size: int = 48
    lr: float = 1e-3
    weight_decay: float = 0.05

    def __post_init__(self) -> None:
        if min(self.steps, self.batch_size) < 1:
            raise ValueError(f"steps and batch_size must be at least 1, got {self.steps} and {self.batch_size}")
        if not self.lr > 0 or self.weight_decay < 0:
            raise ValueError(f"lr must be above 0 and weight_decay not below, got {self.lr} and {self.weight_decay}")


def lessons_of(reflector: PathReflector, episodes: Episodes) -> Iterator[Lesson]:
    """See :meth:`PathReflector.train_on`; what is wrong with the episodes is said before the lesson."""
    if "success" not in episodes:
        raise ValueError("the episodes carry no success labels: a reflector learns from rollouts that are labelled")
    episodes.require("the reflector", reflector.cameras, reflector.image_size)
    unknown = sorted(set(episodes.instructions) - set(reflector.instructions))
    if unknown:
        raise ValueError(
            f"the reflector has cameras for {len(reflector.instructions)} instructions, {unknown[0]!r} is not among "
            "them: name every instruction of the training in its config"
        )
    return _lessons(reflector, episodes)


def _lessons(reflector: PathReflector, episodes: Episodes) -> Iterator[Lesson]:
    plan, device, stride = reflector.lessons, device_of(reflector), reflector.config.stride
    poses = ForwardKinematics.commanded_pose(episodes["kinematic_states"])[:, ::stride].to(device)
    weight = episodes.alive[:, ::stride].float().to(device)
    label = (episodes["success"].long().cummax(1).values[:, ::stride] > 0).to(device)
    words = reflector.vocabulary.ids(episodes.instructions, device)
    _fit_statistics(reflector, poses, weight)
    path, seen = reflector.path(poses), _all_crops(reflector, episodes, poses)
    pools = [(episodes[TASK_ID].squeeze(-1) == task).nonzero().squeeze(-1) for task in episodes[TASK_ID].unique()]

    def sample() -> TensorDict:
        share = max(1, plan.batch_size // len(pools))
        rows = torch.cat([pool[torch.randint(len(pool), (share,))] for pool in pools]).to(device)
        light = 1 + _LIGHT * torch.randn(len(rows), 1, 1, 1, 1, device=device)
        told = path[rows]
        return TensorDict(
            {
                "crops": light * (seen[rows].float() / 255 - 0.5),
                "path": told + _PATH_NOISE * torch.randn_like(told),
                "words": words[rows],
                "label": label[rows],
                "weight": weight[rows],
            },
            batch_size=[len(rows)],
        )

    yield Lesson("paths", list(reflector.members.parameters()), sample, plan.steps, plan.lr, plan.weight_decay)


def _fit_statistics(reflector: PathReflector, poses: Tensor, weight: Tensor) -> None:
    """Mean and spread of what the networks are told; what never changes, such as a fixed rotation, stays as it is."""
    reflector.mean.zero_()
    reflector.std.fill_(1.0)
    told = reflector.path(poses)[weight > 0]
    reflector.mean.copy_(told.mean(0))
    reflector.std.copy_(told.std(0).clamp(min=1e-3))


@torch.no_grad()
def _all_crops(reflector: PathReflector, episodes: Episodes, poses: Tensor) -> Tensor:
    """The crops of all episodes at all looks, as bytes."""
    parts = []
    for rows in torch.arange(len(episodes)).split(_EPISODES_AT_ONCE):
        start, texts = torch.zeros_like(rows), [episodes.instructions[row] for row in rows.tolist()]
        shown = [episodes.frames(camera, rows, start) for camera in reflector.cameras]
        first = torch.stack(shown, 1).to(poses.device)
        seen = reflector.crops(first, reflector.views_of(texts).to(poses.device), poses[rows.to(poses.device)])
        parts.append(((seen + 0.5) * 255).round().to(torch.uint8))
    return torch.cat(parts)
