"""Loops that continue where they were, bit for bit, on ``torchrl.checkpoint``.

A loop of a stage names what its next step depends on::

    steps = Resumable(run, "l1", 1500, policy=policy, optimizer=optimizer, schedule=schedule)
    for step in steps.bar("sft l1"):
        ...

From then on it is saved every ``checkpoint_minutes``, between two steps, to ``resume/<stage>/`` of the run folder: each
time under a name of its own and only when it is complete; the last two are kept until the stage is finished. The same
command after a crash or ``kill -9`` makes everything up to the loop again, the same by the stage's seed, and then goes
on from the newest checkpoint that is whole. What the stage had logged since is logged again. On a CPU with as many
threads as before, the weights at the end are those of a run that was never interrupted, bit for bit.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import torch
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRotation,
    GlobalRNGState,
    StateDictCheckpointAdapter,
)
from tqdm import tqdm

import processes
from run import Run
from worldenv_trl.memmap import check_room

_KEPT = 2


class NotResumable(ValueError):
    """A checkpoint that is whole but belongs to something else."""


class Outside:
    """A component whose content lies in files of its own, which a checkpoint only continues.

    Its ``state_dict`` leaves them on the disk and says how far they go; its ``load_state_dict`` raises ``ValueError``,
    and changes nothing, where that is not there any more: the checkpoint before is taken then. Of several processes
    each has files of its own.
    """

    def __init__(self, component: Any) -> None:
        self._component = component

    def state_dict(self) -> dict[str, Any]:
        return _of_all(self._component.state_dict())

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        try:
            self._component.load_state_dict(_own(state_dict))
        except ValueError as error:
            raise _Lost(str(error)) from error


class _Lost(ValueError):
    """What a checkpoint continues is no longer as it was."""


class Resumable:
    """The numbers of the steps that are left of a loop; see the module.

    Outside a stage (:meth:`run_folder.RunFolder.stage`) nothing is saved and the loop begins at 0.

    Args:
        run: in whose folder the running stage works.
        name: of the loop, unique in its stage.
        total: its steps.
        minutes: between two checkpoints; ``checkpoint_minutes`` of the settings when None, 0 saves after every step.
        components: what the next step depends on. Objects with ``state_dict`` and ``load_state_dict`` (:class:`Outside`
            where their content is too much for a checkpoint), or dicts and lists of plain values that are changed in
            place; those that are None are left out. Random states (torch,
            NumPy, Python) and the stage's metrics are always saved. They are restored here, so that what is derived
            from them comes after.

    Of several processes the main one writes, and decides when; all must come here alike. What the components say is
    asked of all of them, so that they may put their states together; every process has random states of its own.

    Raises:
        NotResumable: if the newest whole checkpoint does not fit the components, or the number of processes.
    """

    def __init__(self, run: Run, name: str, total: int, *, minutes: float | None = None, **components: Any) -> None:
        self._folder, self._stage = run.folder, run.folder.running
        self.name, self.total, self.step = name, total, 0
        self._minutes = run.config.checkpoint_minutes if minutes is None else minutes
        self._noted: dict[str, Any] = {}
        self._checkpoint = Checkpoint(format="archive")  # a ZIP file: its checksums tell what is cut short
        everything = components | {"random": _RandomStates(), "noted": self._noted}
        self._outside = {key for key, component in components.items() if isinstance(component, Outside)}
        for key, component in everything.items():
            if component is not None:
                if processes.size() > 1 and hasattr(component, "load_state_dict"):
                    component = _Asked(component)
                keeps_state = hasattr(component, "load_state_dict")  # a buffer's own dump would write its frames, too
                adapter = StateDictCheckpointAdapter("consolidated") if keeps_state else None
                self._checkpoint.register(key, component, adapter=adapter)
        if self._stage is not None:
            folder = self._folder.progress(self._stage)
            self._rotation = CheckpointRotation(folder, keep_last=_KEPT, prefix=quote(name, safe=""))
            self._restore(self._stage)
        self._saved_at = time.monotonic()

    def __iter__(self) -> Iterator[int]:
        while self.step < self.total:
            yield self.step
            self.step += 1
            if self.step == self.total or self._due():
                self.save()

    def bar(self, label: str, unit: str = "step") -> tqdm:
        """The steps with a progress bar."""
        hidden = not processes.is_main()
        return tqdm(self, desc=label, total=self.total, initial=self.step, unit=unit, disable=hidden)

    def _due(self) -> bool:
        return processes.agreed(time.monotonic() - self._saved_at >= 60 * self._minutes)

    # ------------------------------------------------------------------------------------------------- saving

    def save(self) -> None:
        """Saves what the next step depends on. A full disk costs a line on stderr and no more: the older checkpoints
        stay, and the next attempt comes when it is due."""
        if self._stage is None:
            return
        for component in self._checkpoint.components.values():
            if isinstance(component, _Asked):
                component.ask()
        if not processes.is_main():
            return
        lines = [json.dumps(line) for line in self._folder.read_metrics(self._stage)]
        self._noted |= {"step": self.step, "seconds": self._folder.stage_seconds(), "metrics": lines}
        try:
            folder = self._rotation.directory
            folder.mkdir(parents=True, exist_ok=True)
            states = [each.state_dict() for each in self._checkpoint.components.values() if hasattr(each, "state_dict")]
            # It is put together and then packed. Mapped files on a full disk would kill the process without a word.
            check_room(folder, 2 * _nbytes(states) + 2**20, "the checkpoint")
            self._rotation.save(self._checkpoint, step=self.step, metadata={"world_size": processes.size()})
        except (OSError, RuntimeError) as error:
            said = f"warning: {self._stage}, {self.name}: no checkpoint after step {self.step} ({error})"
            tqdm.write(f"{said}; the run goes on, older checkpoints stay", file=sys.stderr)
        self._saved_at = time.monotonic()

    # ------------------------------------------------------------------------------------------------- restoring

    def _restore(self, stage: str) -> None:
        path = processes.on_main(self._newest)
        if path is None:
            return
        self._load(path)
        self._folder.restore_stage(stage, self._noted["seconds"], map(json.loads, self._noted["metrics"]))
        self.step = self._noted["step"]
        done = f"continues after step {self.step} of {self.total}"
        if processes.is_main():
            tqdm.write(f"{stage}: {self.name} {'was finished' if self.step == self.total else done}")

    def _newest(self) -> Path | None:
        """The newest whole checkpoint; what is left of others goes."""
        folder = self._rotation.directory
        for left in folder.glob(".*"):  # of a process that was killed while it saved
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink()
        broken, whole = [], None
        for path in sorted(folder.glob(f"{self._rotation.prefix}-{12 * '[0-9]'}.torchrl"), reverse=True):
            lost = self._lost(path) if _is_whole(path) else f"{path} is cut short or damaged"
            if lost is None:
                whole = path
                break
            broken.append(path)
            tqdm.write(f"warning: {lost}: the one before it is taken, if any", file=sys.stderr)
        for path in broken:  # a later step in its name would keep newer ones from being the newest
            path.unlink()
        return whole

    def _lost(self, path: Path) -> str | None:
        """What is no longer there of that which a whole checkpoint continues."""
        there = self._outside & set(Checkpoint.manifest(path)["components"])
        if not there:
            return None
        try:
            self._checkpoint.load(path, components=there)
        except CheckpointError as error:
            if isinstance(error.__cause__, _Lost):
                return f"{error.__cause__}, which {path.name} continues"
        return None

    def _load(self, path: Path) -> None:
        remedy = f"delete {path.parent} to begin the stage anew"
        manifest = Checkpoint.manifest(path)
        saved_by = manifest["metadata"].get("world_size")
        if saved_by != processes.size():
            raise NotResumable(f"{path} was saved by {saved_by} processes, now {processes.size()}: {remedy}")
        differ = sorted(set(manifest["components"]) ^ set(self._checkpoint.components))
        if differ and processes.is_main():  # another one may do without some
            raise NotResumable(f"{path} is of another loop: it differs in {', '.join(differ)}; {remedy}")
        try:
            self._checkpoint.load(path)
        except CheckpointError as error:
            said = " ".join(str(error).split())
            raise NotResumable(f"{path} is of other settings, parts or another release ({said}): {remedy}") from error


class _Asked:
    """A component whose state was asked for in all processes before the main one writes it."""

    def __init__(self, component: Any) -> None:
        self._component = component
        self.load_state_dict = component.load_state_dict

    def ask(self) -> None:
        self._state = self._component.state_dict()

    def state_dict(self) -> Any:
        return self._state


class _RandomStates:
    """Random states of all processes; each takes up its own."""

    def state_dict(self) -> dict[str, Any]:
        return _of_all(GlobalRNGState().state_dict())

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        GlobalRNGState().load_state_dict(_own(state_dict))


def _of_all(state: dict[str, Any]) -> dict[str, Any]:
    """The states of all processes, or that of a single one."""
    states = processes.gathered_values(state)
    return states[0] if len(states) == 1 else {f"process_{rank}": each for rank, each in enumerate(states)}


def _own(states: dict[str, Any]) -> dict[str, Any]:
    """This process's one of :func:`_of_all`."""
    return states.get(f"process_{processes.rank()}", states)


def _is_whole(path: Path) -> bool:
    try:
        Checkpoint.manifest(path)
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except Exception:  # damaged bytes raise what they happen to look like
        return False


def _nbytes(state: Any) -> int:
    """Of the tensors in nested dicts, lists and tuples."""
    if isinstance(state, torch.Tensor):
        return state.nbytes
    if isinstance(state, Mapping):
        return sum(map(_nbytes, state.values()))
    return sum(map(_nbytes, state)) if isinstance(state, list | tuple) else 0
