"""What viewers show of recorded rollouts: images, hand poses, text and named curves over time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from worldenv_trl.keys import (
    ACTION_MAP,
    CHUNK,
    CONTROL_HZ,
    FRAMES,
    IMAGE,
    INSTRUCTION,
    KINEMATIC_DIM,
    KINEMATIC_STATE,
    MASK,
    STEP_MASK,
    SUCCESS,
    TASK_ID,
    TERMINATION,
    TERMINATIONS,
)
from worldenv_trl.record.mcap.provenance import replayed_from
from worldenv_trl.record.mcap.reader import read_rollouts
from worldenv_trl.record.mcap.recording import Recording
from worldenv_trl.record.mcap.stream import painted
from worldenv_trl.record.mcap.tasks import task_names, task_numbers
from worldenv_trl.record.replay.branch import ACTION_NAMES
from worldenv_trl.record.replay.source import image_entries, observed, steps_around
from worldenv_trl.robot import Camera

__all__ = ["Curve", "Shown", "shown_rollouts"]

STATE_NAMES = ("x", "y", "z", "rx", "ry", "rz", "opening")
_PER_STEP = {"log_probs", "ratio", "clipped", "psnr"}  # beside everything that is [C, ...] for each decision
_NUMBERS = {"task_id", "context_id", "noise_seed", "row", "episode", "step_mask", "action_is_pad", "text"}
_WIDEST = KINEMATIC_DIM  # a wider entry, such as the physical state, is no curve for the eye


@dataclass(frozen=True)
class Curve:
    """Values [n, width] of an entry after ``steps`` [n] env steps, with a label for each column."""

    name: str
    steps: Tensor
    values: Tensor
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Shown:
    """One rollout for the eye; ``start`` is when it plays in its file (s), a step takes 1 / 20 s.

    ``images``: name -> steps [n] and frames uint8 [n, 3, H, W], for each camera and, in a replay, what was recorded of
    it (``recorded/<name>``), and ``action_map``; ``states`` float [n, 7] after ``state_steps``. ``replayed``: what it
    is a replay of, empty if it is none.
    """

    number: int
    start: float
    instruction: str
    outcome: str
    images: dict[str, tuple[Tensor, Tensor]]
    state_steps: Tensor
    states: Tensor
    curves: list[Curve]
    replayed: str

    def seconds(self, steps: Tensor) -> Tensor:
        return self.start + steps.double() / CONTROL_HZ


def shown_rollouts(path: str | os.PathLike, rollouts: Sequence[int] | slice = slice(None)) -> Iterator[Shown]:
    """The rollouts of one recording, all or those that are named, for a viewer.

    Raises:
        FileNotFoundError, ValueError: as :func:`~worldenv_trl.record.read_rollouts`.
    """
    recording = Recording(_file(path))
    chosen = recording.numbers()[rollouts] if isinstance(rollouts, slice) else list(rollouts)
    for number in chosen:
        entries = read_rollouts(path, rollouts=number)[0]
        entries = entries[entries[MASK]]
        if len(entries):
            parts = recording.parts(lambda each, *_, number=number: each == number, lambda _: False)
            yield _shown(entries, number, parts[0].starts[0] / 1e9, recording.metadata)


def _file(path: str | os.PathLike) -> Path:
    from worldenv_trl.record.mcap.reader import _require_file

    return _require_file(path)


def _shown(entries: TensorDict, number: int, start: float, metadata: dict[str, Any]) -> Shown:
    seen = observed(entries)
    first = steps_around(entries)[0]
    have = set(entries.keys(True, True))
    images = {}
    for name in image_entries(entries):
        images[name] = seen[name]
        if ("next", "recorded", name) in have:
            images[f"recorded/{name}"] = steps_around(entries)[1], entries["next", "recorded", name]
        if ("next", "recorded", FRAMES, name) in have:
            images[f"recorded/{name}"] = _per_step(entries, entries["next", "recorded", FRAMES, name], first)
    if ("next", ACTION_MAP) in have:
        images["action_map"] = steps_around(entries)[1], entries["next", ACTION_MAP]
    elif "kinematic_state" in seen and IMAGE[1] in images:
        drawn = _drawn(entries, seen["kinematic_state"][1], images[IMAGE[1]][1].shape[-1], metadata)
        if drawn is not None:
            images["action_map"] = seen["kinematic_state"][0], drawn
    state_steps, states = seen.get("state", (torch.zeros(0, dtype=torch.int64), torch.zeros(0, 7)))
    words = entries.get(INSTRUCTION, "")
    words = words if isinstance(words, str) else (words.tolist() or [""])[0]
    outcome, curves = _outcome(entries, have), _curves(entries)
    return Shown(number, start, words, outcome, images, state_steps, states, curves, replayed_from(metadata))


def _per_step(entries: TensorDict, values: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """Values [T, C, ...] of what was executed, with the steps after which they hold."""
    mask = entries["next", STEP_MASK]
    return (first.unsqueeze(-1) + 1 + torch.arange(mask.shape[1]))[mask], values[mask]


def _curves(entries: TensorDict) -> list[Curve]:
    have = set(entries.keys(True, True))
    first, last = steps_around(entries)
    length = entries["next", STEP_MASK].shape[1] if ("next", STEP_MASK) in have else 0
    curves = []
    for key in sorted(have, key=str):
        path: tuple[str, ...] = (key,) if isinstance(key, str) else key
        below = path[1:] if path[0] == "next" else path
        if (path[0] != "next" and ("next", *path) in have) or below == MASK or below[-1] in _NUMBERS:
            continue
        value = entries[key]
        if not isinstance(value, Tensor) or value.ndim > 3:  # an image
            continue
        chunked = length and value.ndim > 1 and value.shape[1] == length
        if chunked and (value.ndim == 3 or below[-1] in _PER_STEP):
            steps, value = _per_step(entries, value, first)
            steps = steps if path[0] == "next" else steps - 1
        else:
            steps = last if path[0] == "next" else first
        value = value.reshape(len(value), -1)
        labels = _labels(below, value.shape[1])
        name = "/".join(below)
        if labels == STATE_NAMES:  # metres and radians, on curves of their own
            curves.append(Curve(f"{name}/rotation", steps, value[:, 3:6].double(), STATE_NAMES[3:6]))
            name, value, labels = f"{name}/position", value[:, [0, 1, 2, 6]], (*STATE_NAMES[:3], STATE_NAMES[6])
        if 0 < value.shape[1] <= _WIDEST:
            curves.append(Curve(name, steps, value.double(), labels))
    return curves


def _labels(path: tuple[str, ...], width: int) -> tuple[str, ...]:
    if width == 1:
        return (path[-1],)
    if width == 7:
        return ACTION_NAMES if path[0] in ("action", CHUNK[0]) else STATE_NAMES
    return tuple(f"{path[-1]}[{place}]" for place in range(width))


def _outcome(entries: TensorDict, have: set) -> str:
    if ("next", TERMINATION) in have:
        return TERMINATIONS[int(entries["next", TERMINATION][-1])]
    said = []
    if ("next", SUCCESS) in have:
        said.append("success" if bool(entries["next", SUCCESS][-1]) else "no success")
    if ("next", STEP_MASK) in have and ("next", "terminated") in have:
        said.append("stopped" if bool(entries["next", "terminated"][-1]) else "not stopped")
    return ", ".join(said)


def _drawn(entries: TensorDict, kinematic: Tensor, size: int, metadata: dict[str, Any]) -> Tensor | None:
    """The action maps uint8 [n, 3, H, W] of kinematic states, through the recorded camera."""
    if KINEMATIC_STATE not in entries.keys() or TASK_ID not in entries.keys():  # noqa: SIM118
        return None
    number, known = int(entries[TASK_ID][0, 0]), task_numbers(metadata) or []
    task = task_names(metadata)[known.index(number)] if number in known else None
    seen_by = metadata.get("calibration", {}).get(task, {}).get("agentview")
    if seen_by is None:
        return None
    from worldenv_trl.kinematics import ActionMap, ForwardKinematics

    camera = Camera("agentview", seen_by["position"], seen_by["rotation"], seen_by["fovy"])
    with torch.no_grad():
        return painted(ActionMap(camera, size)(ForwardKinematics().pose(kinematic)))
