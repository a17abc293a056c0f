"""What a :class:`PathReflector` is trained on: whole episodes, each by its first frame, its path and its labels."""

from __future__ import annotations

import math
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
from worldenv_trl.reflectors.places import offsets, places_of
from worldenv_trl.reflectors.pools import drawn, share

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes
    from worldenv_trl.reflectors.path import PathReflector

__all__ = ["PathLessons"]

_PATH_NOISE = 0.05  # of normalised entries
_BESIDE = 0.003  # m by which an episode's hands are moved: in the physics that hardly changes how it ends
_LIGHT = 0.1  # standard deviation of a frame's contrast
_EPISODES_AT_ONCE = 64


@dataclass(frozen=True)
class PathLessons:
    """How long a :class:`PathReflector` learns, by how much there is to learn from.

    Args:
        epochs: times that it draws as many paths as there are episodes, in whole batches, one at least.
        place_epochs: likewise of places, before.
        batch_size: episodes in a batch, shared by the tasks.
        lr: the highest learning rate.
        weight_decay: of AdamW.

    Raises:
        ValueError: for numbers out of range.
    """

    epochs: float = 20.0
    place_epochs: float = 10.0
    batch_size: int = 48
    lr: float = 1e-3
    weight_decay: float = 0.05

    def __post_init__(self) -> None:
        if not (0 < self.epochs < math.inf and 0 < self.place_epochs < math.inf) or self.batch_size < 1:
            raise ValueError(
                "epochs and place_epochs must be above 0 and batch_size at least 1, "
                f"got {self.epochs}, {self.place_epochs} and {self.batch_size}"
            )
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
    texts = episodes.instructions
    view, words = reflector.views_of(texts).to(device), reflector.vocabulary.ids(texts, device)
    first, number = _first_frames(reflector, episodes), episodes[TASK_ID].squeeze(-1)
    _fit_statistics(reflector, poses, weight)

    place, reached = places_of(poses[..., :3], label), label[:, -1]
    if reached.any():
        reflector.places.fit(place, reached, texts, poses[..., :3])
    levels = reflector.places.levels(texts)
    succeeded, tasks = (
        _by_task(number, chosen) for chosen in (reached.cpu(), torch.ones_like(number, dtype=torch.bool))
    )

    def steps_of(epochs: float, pools: list[Tensor]) -> int:
        return math.ceil(epochs * len(episodes) / (len(pools) * share(pools, plan.batch_size)))

    def sample_places() -> TensorDict:
        rows = drawn(succeeded, plan.batch_size)
        here = rows.to(device)
        return TensorDict(
            {
                "first": first[rows].to(device),
                "view": view[here],
                "words": words[here],
                "levels": levels[here],
                "place": place[here],
            },
            batch_size=[len(rows)],
        )

    if succeeded:
        finds = list(reflector.places.parameters())
        steps = steps_of(plan.place_epochs, succeeded)
        yield Lesson("places", finds, sample_places, steps, plan.lr, plan.weight_decay, by_epochs=True)

    crops, points = [], []
    with torch.no_grad():
        for rows in torch.arange(len(episodes)).split(_EPISODES_AT_ONCE):
            here, frames = rows.to(device), first[rows].to(device)
            seen = reflector.crops(frames, view[here], poses[here])
            crops.append(((seen + 0.5) * 255).round().to(torch.uint8))
            points.append(reflector.places(frames, view[here], words[here], levels[here])[1])
    looks, moves, hands, there = torch.cat(crops), reflector.moves(poses), poses[..., :3], torch.cat(points)

    def sample_paths() -> TensorDict:
        rows = drawn(tasks, plan.batch_size).to(device)
        light = 1 + _LIGHT * torch.randn(len(rows), 1, 1, 1, 1, device=device)
        moved, beside = moves[rows], _BESIDE * torch.randn(len(rows), 1, 3, device=device)
        apart = offsets(hands[rows] + beside, there[rows])
        return TensorDict(
            {
                "crops": light * (looks[rows].float() / 255 - 0.5),
                "path": torch.cat([moved + _PATH_NOISE * torch.randn_like(moved), apart], -1),
                "words": words[rows],
                "label": label[rows],
                "weight": weight[rows],
            },
            batch_size=[len(rows)],
        )

    judges = list(reflector.members.parameters())
    steps = steps_of(plan.epochs, tasks)
    yield Lesson("paths", judges, sample_paths, steps, plan.lr, plan.weight_decay, by_epochs=True)


def _by_task(number: Tensor, chosen: Tensor) -> list[Tensor]:
    """The chosen rows of each task that has some."""
    each = [((number == task) & chosen).nonzero().squeeze(-1) for task in number.unique()]
    return [rows for rows in each if len(rows)]


def _fit_statistics(reflector: PathReflector, poses: Tensor, weight: Tensor) -> None:
    """Mean and spread of what the networks are told; what never changes, such as a fixed rotation, stays as it is."""
    reflector.mean.zero_()
    reflector.std.fill_(1.0)
    told = reflector.moves(poses)[weight > 0]
    reflector.mean.copy_(told.mean(0))
    reflector.std.copy_(told.std(0).clamp(min=1e-3))


def _first_frames(reflector: PathReflector, episodes: Episodes) -> Tensor:
    """uint8 [R, V, 3, H, W], on the CPU: a third of the crops' bytes at 64 px."""
    parts = []
    for rows in torch.arange(len(episodes)).split(_EPISODES_AT_ONCE):
        shown = [episodes.frames(camera, rows, torch.zeros_like(rows)) for camera in reflector.cameras]
        parts.append(torch.stack(shown, 1))
    return torch.cat(parts)
