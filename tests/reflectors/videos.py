"""Labelled videos in memory, and a training loop as short as a recipe's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from worldenv_trl.data import Episodes
from worldenv_trl.keys import TASK_ID, frames_key
from worldenv_trl.reflectors import Lesson, Reflector


class Videos(Episodes):
    """Episodes with films uint8 [R, T + 1, 3, H, W] by camera; remembers the most frames read at once."""

    def __init__(
        self,
        films: Mapping[str, Tensor],
        instructions: Sequence[str],
        success: Tensor | None = None,
        task: Sequence[int] | None = None,
        length: Sequence[int] | None = None,
    ) -> None:
        count, frames = next(iter(films.values())).shape[:2]
        length = torch.tensor(length or [frames - 1] * count).unsqueeze(-1)
        alive = torch.arange(frames) <= length
        entries = {
            "actions": torch.zeros(count, frames - 1, 7),
            "length": length,
            TASK_ID: torch.tensor(task or [0] * count).unsqueeze(-1),
        } | ({} if success is None else {"success": success})
        shown = TensorDict(batch_size=[int(alive.sum())])
        for camera, film in films.items():
            shown[frames_key(camera)] = film[alive]
        super().__init__(TensorDict(entries, batch_size=[count]), instructions, shown)
        self.films, self.most_frames = dict(films), 0

    def frames(self, camera: str, episode: Tensor, frame: Tensor) -> Tensor:
        shown = super().frames(camera, episode, frame)
        self.most_frames = max(self.most_frames, shown[..., 0, 0, 0].numel())
        return shown


def patches(count: int, instructions: Sequence[str], *, seed: int = 0, size: int = 16, frames: int = 9) -> Videos:
    """Noise in which a bright patch appears, left or right; what an instruction names first counts."""
    generator = torch.Generator().manual_seed(seed)
    video = torch.randint(0, 40, (count, frames, 3, size, size), generator=generator, dtype=torch.uint8)
    onset = torch.randint(1, frames + 3, (count,), generator=generator)
    left = torch.rand(count, generator=generator) < 0.5
    shown = torch.arange(frames) >= onset.unsqueeze(-1)
    for row in range(count):
        columns = slice(1, size // 2 - 1) if left[row] else slice(size // 2 + 1, size - 1)
        video[row, shown[row], :, 4:12, columns] = 250
    task = [row % len(instructions) for row in range(count)]
    texts = [instructions[number] for number in task]
    wanted = torch.tensor([text.split().index("left") < text.split().index("right") for text in texts])
    return Videos({"agentview": video}, texts, shown & (wanted == left).unsqueeze(-1), task)


def work_through(reflector: Reflector) -> Callable[[Lesson], list[float]]:
    """What a recipe does with a lesson; gives its losses."""

    def teach(lesson: Lesson) -> list[float]:
        optimizer = torch.optim.AdamW(lesson.parameters, lr=lesson.lr, weight_decay=lesson.weight_decay)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lesson.lr, total_steps=lesson.steps)
        losses = []
        for _ in range(lesson.steps):
            out = reflector.training_loss(lesson.sample())
            optimizer.zero_grad()
            out["loss_reflector"].backward()
            optimizer.step()
            schedule.step()
            losses.append(out["loss_reflector"].item())
        return losses

    return teach
