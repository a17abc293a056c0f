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

from worldenv_trl.keys import (
    ACTION,
    CHUNK,
    FRAMES,
    IMAGE,
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
)
from worldenv_trl.record.mcap.reader import read_attachments, read_metadata, read_rollouts

if TYPE_CHECKING:
    from worldenv_trl.scenes import Task

__all__ = ["Source", "observed", "open_rollout", "recorded_task"]

# What is compared, in the order in which causes come before effects, and where decisions keep it step by step.
FIELDS = (
    (SIM_STATE, None),
    (KINEMATIC_STATE, KINEMATIC_STATES),
    (STATE, STATES),
    (IMAGE, FRAMES),
    (WRIST_IMAGE, None),
    (SUCCESS, None),
    (SUCCESS_PROB, None),
)


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


def observed(entries: TensorDictBase, first: int = 0) -> dict[str, tuple[Tensor, Tensor]]:
    """What entries [T] show, by name: after how many env steps int64 [n], and the values [n, ...].

    Step 0 is the reset, if ``first``, the steps before these entries, is 0. Of decisions that keep what lies between
    their observations, every executed step is given.
    """
    have = set(entries.keys(True, True))
    mask = entries["next", STEP_MASK] if ("next", STEP_MASK) in have else None
    executed = torch.ones(len(entries), dtype=torch.int64) if mask is None else mask.sum(-1)
    last = first + executed.cumsum(0)
    out = {}
    for key, between in FIELDS:
        path = (key,) if isinstance(key, str) else key
        if between is not None and ("next", between) in have and mask is not None:
            steps, values = first + 1 + torch.arange(int(executed.sum())), entries["next", between][mask]
        elif ("next", *path) in have:
            steps, values = last, entries[("next", *path)]
        else:
            continue
        if key in have:
            start = torch.tensor([first])
            steps, values = torch.cat([start, steps]), torch.cat([entries[key][:1], values])
        out[path[-1]] = steps, values
    return out


def recorded_task(source: Source, notes: list[str]) -> Task:
    """The task of a rollout, from the file that is attached to the recording if it was one.

    Raises:
        ValueError: if neither the file nor this release knows the task.
    """
    from worldenv_trl.scenes import list_suites, list_tasks, load_task
    from worldenv_trl.scenes.files import load_bddl

    if TASK_ID not in source.entries.keys():  # noqa: SIM118 - a TensorDict iterates over rows
        raise ValueError(f"{source.path} does not say of which task its rollouts are ({TASK_ID!r} is missing)")
    number = int(source.entries[TASK_ID][0, 0])
    names, numbers = source.metadata.get("tasks", []), source.metadata.get("task_ids", [])
    attached = read_attachments(source.path)
    if number in numbers:
        place = numbers.index(number)
        text = attached.get(f"{place}.bddl")
        if text is not None:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "task.bddl"
                path.write_bytes(text)
                task = load_bddl(path, name=names[place], task_id=number)
        else:
            task = load_task(names[place])
        _compare_scene(task, attached.get(f"{place}.mjb"), source, notes)
        return task
    for name in (name for suite in ("starter", *list_suites()) for name in list_tasks(suite)):
        if load_task(name).task_id == number:
            notes.append(f"the file does not name its tasks: task {number} is taken for {name}")
            return load_task(name)
    raise ValueError(f"{source.path}: task {number} is not known, and the file does not describe it")


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
