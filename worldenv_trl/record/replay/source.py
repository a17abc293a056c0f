"""One recorded rollout, laid out by env step so that another one can be held against it."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.context_ids import parts_of
from worldenv_trl.keys import (
    ACTION,
    CHUNK,
    CONTEXT_ID,
    FRAMES,
    IMAGE,
    INSTRUCTION,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    MASK,
    NOISE_SEED,
    SIM_STATE,
    STATE,
    STATES,
    STEP_MASK,
    SUCCESS,
    SUCCESS_PROB,
    TASK_ID,
    WRIST_IMAGE,
    camera_of,
)
from worldenv_trl.language import instructions_of
from worldenv_trl.record.mcap.reader import read_attachments, read_metadata, read_rollouts
from worldenv_trl.record.mcap.tasks import task_names, task_numbers

if TYPE_CHECKING:
    from worldenv_trl.scenes import Task

__all__ = ["Source", "image_entries", "observed", "open_rollout", "recorded_task", "steps_around"]


@dataclass(frozen=True)
class Source:
    """A rollout of a file: its entries [T], what the file says about itself, and the env steps they stand for.

    ``first`` and ``last`` int64 [T]: env steps executed before and after each entry.
    """

    path: Path
    number: int
    entries: TensorDict
    metadata: dict[str, Any]
    first: Tensor
    last: Tensor

    @property
    def imagined(self) -> bool:
        return ("next", NOISE_SEED) in self.entries.keys(True, True)

    @property
    def steps(self) -> int:
        return int(self.last[-1])

    @property
    def actions(self) -> Tensor:
        """The env actions as they were given, float32 [steps, 7]."""
        if ACTION in self.entries.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            return self.entries[ACTION]
        return self.entries[CHUNK][self.entries["next", STEP_MASK]]

    @property
    def cameras(self) -> tuple[str, ...]:
        """The scene cameras whose images it shows."""
        return tuple(camera_of(entry) for entry in image_entries(self.entries))

    @property
    def image_size(self) -> int | None:
        """Height and width (px) of its images, None if it shows none."""
        for name in image_entries(self.entries):
            for part in (self.entries, self.entries["next"]):
                if ("observation", name) in part.keys(True):
                    return part["observation", name].shape[-1]
        return None

    @property
    def task_id(self) -> int | None:
        """What the rollout calls its task, None if it does not say."""
        if TASK_ID in self.entries.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            return int(self.entries[TASK_ID][0, 0])
        if CONTEXT_ID in self.entries.keys() and int(self.entries[CONTEXT_ID][0, 0]) >= 0:  # noqa: SIM118
            return parts_of(int(self.entries[CONTEXT_ID][0, 0]))[0]
        return None

    @property
    def instruction(self) -> str:
        """What was asked for; empty if it does not say."""
        return instructions_of(self.entries)[0] if self.entries.get(INSTRUCTION, None) is not None else ""

    @property
    def env(self) -> dict[str, Any]:
        """The env's settings; empty if the file does not say."""
        return self.metadata.get("env", {})

    @property
    def models(self) -> dict[str, str]:
        return self.metadata.get("models", {})


def open_rollout(path: str | os.PathLike, rollout: int) -> Source:
    """Rollout ``rollout`` of a file.

    Raises:
        FileNotFoundError, ValueError: as :func:`~worldenv_trl.record.read_rollouts`; for a rollout without actions.
    """
    if Path(path).is_dir():
        raise ValueError(f"{path} is a folder: name one recording to replay")
    if isinstance(rollout, bool) or not isinstance(rollout, int):
        raise TypeError(f"rollout must be a number, got {rollout!r}")
    entries = read_rollouts(path, rollouts=rollout)[0]
    entries = entries[entries[MASK]]
    have = set(entries.keys(True, True))
    if ACTION not in have and not {CHUNK, ("next", STEP_MASK)} <= have:
        raise ValueError(
            f"{path} holds no actions ({ACTION!r}, or {CHUNK} with {('next', STEP_MASK)}): it cannot be replayed"
        )
    if not len(entries):
        raise ValueError(f"rollout {rollout} of {path} holds no step: nothing can be replayed")
    executed = torch.ones(len(entries), dtype=torch.int64)
    if ACTION not in have:
        executed = entries["next", STEP_MASK].sum(-1)
    last = executed.cumsum(0)
    return Source(Path(path), rollout, entries, read_metadata(path), last - executed, last)


def image_entries(entries: TensorDictBase) -> list[str]:
    """The names, below ``observation``, of the images in entries [T]: those of TorchRL first, then by name."""
    names = set()
    for part in (entries, entries.get("next", None)):
        shown = None if part is None else part.get("observation", None)
        for name, value in () if shown is None else shown.items():
            if isinstance(value, Tensor) and value.dtype == torch.uint8 and value.ndim == 4 and value.shape[1] == 3:
                names.add(name)
    first = [IMAGE[1], WRIST_IMAGE[1]]
    return sorted(names, key=lambda name: (first.index(name) if name in first else len(first), name))


def steps_around(entries: TensorDictBase, first: int = 0) -> tuple[Tensor, Tensor]:
    """Env steps executed before and after each of the entries [T], which follow ``first`` steps: int64 [T] each."""
    executed = torch.ones(len(entries), dtype=torch.int64)
    if ("next", STEP_MASK) in entries.keys(True, True):
        executed = entries["next", STEP_MASK].sum(-1)
    last = first + executed.cumsum(0)
    return last - executed, last


def observed(entries: TensorDictBase, first: int = 0) -> dict[str, tuple[Tensor, Tensor]]:
    """What entries [T] show, by name: after how many env steps int64 [n], and the values [n, ...].

    Step 0 is the reset, if ``first``, the steps before these entries, is 0. Of decisions that keep what lies between
    their observations, every executed step is given.
    """
    have = set(entries.keys(True, True))
    mask = entries["next", STEP_MASK] if ("next", STEP_MASK) in have else None
    last = steps_around(entries, first)[1]
    out = {}
    for path, between in _compared(entries):
        key = path if len(path) > 1 else path[0]
        if between is not None and ("next", *between) in have and mask is not None:
            steps, values = torch.arange(first + 1, int(last[-1]) + 1), entries["next", *between][mask]
        elif ("next", *path) in have:
            steps, values = last, entries["next", *path]
        else:
            continue
        if key in have:
            start = torch.tensor([first])
            steps, values = torch.cat([start, steps]), torch.cat([entries[key][:1], values])
        out[path[-1]] = steps, values
    return out


def _compared(entries: TensorDictBase) -> list[tuple[tuple[str, ...], tuple[str, ...] | None]]:
    """What is compared, causes before their effects, and where decisions keep it step by step."""
    return [
        ((SIM_STATE,), None),
        ((KINEMATIC_STATE,), (KINEMATIC_STATES,)),
        (STATE, (STATES,)),
        *((("observation", name), (FRAMES, name)) for name in image_entries(entries)),
        ((SUCCESS,), None),
        ((SUCCESS_PROB,), None),
    ]


def recorded_task(source: Source, notes: list[str]) -> Task:
    """The task of a rollout, from the file that is attached to the recording if it was one.

    Raises:
        ValueError: if neither the file nor this release knows the task.
    """
    from worldenv_trl.scenes import load_task
    from worldenv_trl.scenes.files import load_bddl

    place = _place(source)
    if place is None:
        return _task_by_instruction(source, notes)
    name, attached = task_names(source.metadata)[place], read_attachments(source.path)
    text = attached.get(f"{place}.bddl")
    if text is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "task.bddl"
            path.write_bytes(text)
            task = _with_stored_states(load_bddl(path, name=name))
    else:
        task = load_task(name)
    digests = source.metadata.get("digests", [])
    recorded = digests[place] if place < len(digests) else None
    if recorded not in (None, task.digest):
        notes.append(f"the task {name} is not the one that was recorded: its digest was {recorded}, is {task.digest}")
    _compare_scene(task, attached.get(f"{place}.mjb"), source, notes)
    return task


def _with_stored_states(task: Task) -> Task:
    """The same task with the initial states that are stored beside its file, where that is still there."""
    from worldenv_trl.scenes import load_task

    try:
        known = load_task(task.name)
    except (ValueError, FileNotFoundError):
        return task
    return known if known.digest == task.digest else task


def _place(source: Source) -> int | None:
    """The place of the rollout's task among those that the file names; None if it names none, or not which."""
    names, numbers, number = task_names(source.metadata), task_numbers(source.metadata), source.task_id
    if numbers is not None:
        if number is None and len(names) > 1:
            raise ValueError(f"{source.path} does not say of which task its rollouts are ({TASK_ID!r} is missing)")
        if number is not None and number not in numbers:
            raise ValueError(f"{source.path}: task {number} is not known, the file describes {numbers}")
        return 0 if number is None else numbers.index(number)
    return 0 if len(names) == 1 else None


def _task_by_instruction(source: Source, notes: list[str]) -> Task:
    """A task of this release with the rollout's instruction, for a file that says no more."""
    from worldenv_trl.scenes import list_suites, list_tasks, load_task

    names = task_names(source.metadata)
    names = names or [name for suite in dict.fromkeys(("starter", *list_suites())) for name in list_tasks(suite)]
    for name in names if source.instruction else ():
        task = load_task(name)
        if task.language == source.instruction:
            notes.append(f"the file does not say which task it is of: {source.instruction!r} is taken for {name}")
            return task
    raise ValueError(f"{source.path} does not describe its task, and none is called {source.instruction!r}")


def _compare_scene(task: Task, recorded: bytes | None, source: Source, notes: list[str]) -> None:
    import mujoco
    import numpy as np

    if recorded is None or source.metadata.get("versions", {}).get("mujoco") != mujoco.__version__:
        return  # other versions of MuJoCo compile other bytes
    model = task.build()
    compiled = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, compiled)
    if compiled.tobytes() != recorded:
        notes.append(f"the scene of {task.name} is not the one that was recorded: this release compiles another model")
