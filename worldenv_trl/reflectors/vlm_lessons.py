"""What a :class:`VLMReflector` is trained on: embeddings of prefixes, made once."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from worldenv_trl.devices import device_of
from worldenv_trl.keys import TASK_ID
from worldenv_trl.reflectors.base import Lesson

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes
    from worldenv_trl.reflectors.vlm import VLMReflector

__all__ = ["VLMLessons"]


@dataclass(frozen=True)
class VLMLessons:
    """How a :class:`VLMReflector`'s head learns; the paper's numbers where it gives them.

    Args:
        epochs: as many embeddings as there are, this often.
        batch_size: embeddings in a step.
        lr: the highest learning rate.
        prefixes_per_episode: of each episode so many prefixes are embedded, spread evenly; None embeds every one, a
            language pass each.
        holdout: share of the episodes that the head does not learn from, on which it is calibrated; 0 leaves it out.
        calibration_steps: of the second lesson.

    Raises:
        ValueError: for numbers out of range.
    """

    epochs: int = 50
    batch_size: int = 8
    lr: float = 1e-4
    prefixes_per_episode: int | None = 16
    holdout: float = 0.1
    calibration_steps: int = 200

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch_size, self.calibration_steps) < 1:
            raise ValueError(
                "epochs, batch_size and calibration_steps must be at least 1, "
                f"got {self.epochs}, {self.batch_size} and {self.calibration_steps}"
            )
        if not self.lr > 0 or not 0 <= self.holdout <= 0.5:
            raise ValueError(f"lr must be above 0 and holdout in [0, 0.5], got {self.lr} and {self.holdout}")
        if self.prefixes_per_episode is not None and self.prefixes_per_episode < 2:
            raise ValueError(f"prefixes_per_episode must be at least 2, got {self.prefixes_per_episode}")


def lessons_of(reflector: VLMReflector, episodes: Episodes) -> Iterator[Lesson]:
    """See :meth:`VLMReflector.train_on`; what is wrong with the episodes is said before the first lesson."""
    episodes.require("the reflector", reflector.cameras, reflector.image_size)
    if "success" not in episodes:
        raise ValueError(
            "the episodes carry no success labels: imagined ones take those of the recorded rollouts whose actions "
            "they replay"
        )
    plan, device = reflector.lessons, device_of(reflector)

    def both() -> Iterator[Lesson]:
        row, frame = chosen_prefixes(episodes, plan.prefixes_per_episode)
        label = episodes["success"][row, frame]
        embedding = embed(reflector, episodes, row, frame)
        # By number, so that a training that is continued keeps the same apart.
        aside = row % round(1 / plan.holdout) == 0 if plan.holdout else torch.zeros_like(label)
        if len(label[aside].unique()) < 2 or aside.all():
            aside = torch.zeros_like(label)  # there is nothing to calibrate on
        weights = balanced(label[~aside], episodes[TASK_ID].squeeze(-1)[row[~aside]]).to(device)

        def kept(rows: Tensor) -> TensorDict:
            values = {"embedding": embedding[rows.to(device)], "label": label[rows].unsqueeze(-1).to(device)}
            return TensorDict(values, batch_size=[int(rows.sum())])

        learned, held_out = kept(~aside), kept(aside)

        def batch() -> TensorDict:
            drawn = torch.multinomial(weights.cpu(), plan.batch_size, replacement=True)
            return learned[drawn.to(device)]

        reflector.requires_grad_(True).vlm.requires_grad_(False)
        head = list(reflector.head.parameters())
        steps = plan.epochs * math.ceil(len(weights) / plan.batch_size)
        yield Lesson("head", head, batch, steps, plan.lr, by_epochs=True)
        if aside.any():
            reflector.head.requires_grad_(False)
            scaling = [reflector.log_scale, reflector.shift]
            yield Lesson("calibration", scaling, lambda: held_out, plan.calibration_steps, lr=0.05)

    return both()


def chosen_prefixes(episodes: Episodes, count: int | None) -> tuple[Tensor, Tensor]:
    """Episode and last frame, int64 [P] each, of ``count`` prefixes of each episode, spread evenly; None: of all."""
    rows, frames = [], []
    for row, length in enumerate(episodes["length"].squeeze(-1).tolist()):
        many = length + 1 if count is None else min(count, length + 1)
        frame = torch.linspace(0, length, many).round().long()
        rows.append(torch.full_like(frame, row))
        frames.append(frame)
    return torch.cat(rows), torch.cat(frames)


def balanced(label: Tensor, task: Tensor) -> Tensor:
    """Weights [P] under which every task is drawn equally often, and of each task successes as often as failures."""
    weights = torch.zeros(len(label))
    for number in task.unique():
        groups = [(task == number) & (label == value) for value in (True, False)]
        groups = [group for group in groups if group.any()]
        for group in groups:
            weights[group] = 1 / len(groups) / int(group.sum())
    return weights


@torch.no_grad()
def embed(reflector: VLMReflector, episodes: Episodes, row: Tensor, frame: Tensor) -> Tensor:
    """Embeddings float32 [P, D] of prefixes, on the reflector's device; the frames of one episode at a time."""
    device, parts = device_of(reflector), []
    for episode in tqdm(row.unique().tolist(), desc="embedding prefixes", unit="episode", leave=False):
        at = frame[row == episode]
        length = int(at.max()) + 1
        shown = episodes.frames(reflector.config.camera, torch.full((length,), episode), torch.arange(length))
        tokens = reflector.encode({reflector.config.camera: shown.to(device)}).unsqueeze(0)
        texts = [episodes.instructions[episode]] * len(at)
        states = reflector.prefix_states(tokens, torch.zeros_like(at).to(device), at.to(device) + 1, texts)
        parts += [reflector.pool(part) for part in states]
    return torch.cat(parts)
