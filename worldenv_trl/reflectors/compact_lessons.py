"""What a :class:`CompactReflector` is trained on: single frames for its encoder, then prefixes for its reward head."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from worldenv_trl.devices import device_of
from worldenv_trl.keys import TASK_ID, frames_key, image_entry
from worldenv_trl.reflectors.base import Lesson
from worldenv_trl.reflectors.pools import drawn, share

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes
    from worldenv_trl.reflectors.compact import CompactReflector

__all__ = ["CompactLessons"]

_PIXEL_NOISE = 6.0  # standard deviation, of 255
_FEATURE_NOISE = 0.1
_SHIFT = 2  # px
_EPISODES_AT_ONCE = 16  # frames stay on disk until they are looked at


@dataclass(frozen=True)
class CompactLessons:
    """How long a :class:`CompactReflector` learns, by how many tasks there are.

    Args:
        encoder_frames: of each task and outcome, drawn in whole batches for the first lesson, single frames.
        prefixes: likewise for the second.
        batch_size: half the frames or prefixes in a batch, shared by tasks and outcomes.
        lr: the highest learning rate, of either lesson.
        label_smoothing: labels of prefixes become ``s / 2`` and ``1 - s / 2``.

    Raises:
        ValueError: for numbers out of range.
    """

    encoder_frames: int = 6000
    prefixes: int = 10000
    batch_size: int = 32
    lr: float = 1e-3
    label_smoothing: float = 0.02

    def __post_init__(self) -> None:
        if min(self.encoder_frames, self.prefixes, self.batch_size) < 1:
            raise ValueError(
                "encoder_frames, prefixes and batch_size must be at least 1, "
                f"got {self.encoder_frames}, {self.prefixes} and {self.batch_size}"
            )
        if not self.lr > 0 or not 0 <= self.label_smoothing < 1:
            raise ValueError(
                f"lr must be above 0 and label_smoothing in [0, 1), got {self.lr} and {self.label_smoothing}"
            )


def lessons_of(reflector: CompactReflector, episodes: Episodes) -> Iterator[Lesson]:
    """See :meth:`CompactReflector.train_on`; what is wrong with the episodes is said before the first lesson."""
    _check(reflector, episodes)
    plan, draw, device = reflector.lessons, FrameSampler(episodes), device_of(reflector)
    words = reflector.vocabulary.ids(episodes.instructions)  # [R, L]

    def batch(row: Tensor, frame: Tensor) -> TensorDict:
        label = episodes["success"][row, frame].unsqueeze(-1)
        return TensorDict({"words": words[row].to(device), "label": label.to(device)}, batch_size=[len(row)])

    def frames() -> TensorDict:
        row, frame = draw(2 * plan.batch_size)
        out = batch(row, frame)
        for camera in reflector.cameras:
            now, first = (episodes.frames(camera, row, at).to(device) for at in (frame, torch.zeros_like(frame)))
            now, first = _shifted_together(torch.cat([now, first], 1)).split(3, 1)
            now, first = blurred(now, float(torch.rand(()))), blurred(first, float(torch.rand(())))
            out[frames_key(camera)] = now + _PIXEL_NOISE * torch.randn_like(now)
            out["first", image_entry(camera)] = first
        return out

    def head() -> Lesson:
        reflector.encoder.requires_grad_(False)
        features = encode_all(reflector, episodes)

        def prefixes() -> TensorDict:
            row, frame = draw(2 * plan.batch_size)
            out = batch(row, frame)
            sampled, used = reflector.sample_prefixes(features, row.to(device), frame.to(device) + 1)
            out["features"] = sampled + _FEATURE_NOISE * torch.randn_like(sampled)
            out["lengths"] = used.unsqueeze(-1)
            return out

        return Lesson(
            "head", reflector.head_parameters(), prefixes, steps_of(plan.prefixes), plan.lr, weight_decay=1e-2
        )

    def steps_of(frames: int) -> int:
        return math.ceil(frames / share(draw.pools, 2 * plan.batch_size))

    def both() -> Iterator[Lesson]:
        steps = steps_of(plan.encoder_frames)
        yield Lesson("encoder", reflector.encoder_parameters(), frames, steps, plan.lr, weight_decay=1e-3)
        yield head()

    return both()


def _check(reflector: CompactReflector, episodes: Episodes) -> None:
    episodes.require("the reflector", reflector.cameras, reflector.image_size)
    unknown = sorted(set(episodes.instructions) - set(reflector.instructions))
    if unknown:
        raise ValueError(
            f"the reflector was made for {len(reflector.instructions)} instructions, {unknown[0]!r} is not among them: "
            "name every instruction of the training in its config"
        )


class FrameSampler:
    """Draws frames: every task equally often, and of each task successes as often as failures.

    Raises:
        ValueError: for episodes without success labels.
    """

    def __init__(self, episodes: Episodes) -> None:
        if "success" not in episodes:
            raise ValueError(
                "the episodes carry no success labels: imagined ones take those of the recorded rollouts whose actions "
                "they replay"
            )
        success, alive, task = episodes["success"], episodes.alive, episodes[TASK_ID]  # [R, T + 1] twice, [R, 1]
        wanted = [(task == number) & alive & (success == label) for number in task.unique() for label in (True, False)]
        self.pools = [pool.nonzero() for pool in wanted if pool.any()]

    def __call__(self, count: int) -> tuple[Tensor, Tensor]:
        """Episode and frame of about ``count`` frames."""
        row, frame = drawn(self.pools, count).unbind(1)
        return row, frame


def encode_all(reflector: CompactReflector, episodes: Episodes) -> Tensor:
    """Features [R, T + 1, F] of all frames, on the reflector's device, 0 past an episode's end."""
    alive, device = episodes.alive, device_of(reflector)
    features = torch.zeros(*alive.shape, reflector.config.feature_dim, device=device)
    for rows in torch.arange(len(episodes)).split(_EPISODES_AT_ONCE):
        row, frame = alive[rows].nonzero(as_tuple=True)
        row = rows[row]
        shown = {camera: episodes.frames(camera, row, frame).to(device) for camera in reflector.cameras}
        features[row, frame] = reflector.encode(shown)
    return features


def blurred(frames: Tensor, strength: float) -> Tensor:
    """Frames [n, 3, H, W] mixed with their 3x3 mean: imagined frames are softer than rendered ones."""
    smooth = F.avg_pool2d(F.pad(frames.float(), (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return torch.lerp(frames.float(), smooth, strength)


def _shifted_together(both: Tensor) -> Tensor:
    """Moves frames and their first frames [n, 6, H, W] alike, by up to two pixels."""
    dx, dy = torch.randint(2 * _SHIFT + 1, (2,)).tolist()
    height, width = both.shape[-2:]
    return F.pad(both.float(), (_SHIFT,) * 4, mode="replicate")[..., dy : dy + height, dx : dx + width]
