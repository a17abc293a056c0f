"""One folder per run: what every stage reads from and writes to.

``checkpoints/`` learned parts, ``rollouts/*.mcap`` logged rollouts, ``episodes/`` their frames on disk (a cache),
``metrics.jsonl`` one line a measurement, ``plots/*.png``, ``config.yaml`` the exact settings, ``tasks.json`` the
digest of each task, ``versions.json`` the packages it ran with, ``stages/`` one marker per finished stage,
``report.html``, ``logs/`` what ``--logger`` adds, ``error.txt`` the traceback of the last error of a stage,
``begun.json`` whose stages it began with (:mod:`beginning`); while a stage runs, ``resume/<stage>/`` from where it
would continue (:mod:`resumable`) and ``scratch/``. ``run.lock`` keeps a second run out.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

import processes
from folder_lock import FolderLock, lock_folder
from loggers import Loggers
from worldenv_trl.report import machine_versions, read_metrics

MIN_FREE_GB = 1.0
FREE = {
    "run_dir",
    "num_threads",
    "device",
    "parallel",
    "collectors",
    "checkpoint_minutes",
    "logger",
    "begin_from",
}
"""Settings of the machine at hand, and where a run began: it may be continued with others. Only ``device`` and
``collectors`` (``local`` or shares, and how many) change noise and rounding."""
_IDLE = {"explore.replay_shift_m": 0.08, "post_train.held_share": 1.0, "noise": "step"}
"""Of settings that are gone: values at which they did nothing although they read as if they did."""


class RunFolder:
    """A resumable run on disk.

    A stage is finished when its marker exists; its outputs are written under their final names only when complete, so
    a crash loses at most the running stage, which continues from its last checkpoint. Of several processes the main one
    alone writes: in the others nothing is logged or marked, and what would be written is left out.

    Attributes:
        running: the stage that this process is in, if any.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if self.path.exists() and not self.path.is_dir():
            raise NotADirectoryError(f"run_dir must be a folder, {self.path} is a file; choose another --run-dir")
        self.running: str | None = None
        self._seconds = 0.0  # that the running stage has taken before this process
        self._started = 0.0
        self._lock: FolderLock | None = None
        self.loggers = Loggers()

    @property
    def metrics_path(self) -> Path:
        return self.path / "metrics.jsonl"

    def checkpoint(self, name: str) -> Path:
        return self.path / "checkpoints" / name

    def rollouts(self, name: str) -> Path:
        return self.path / "rollouts" / f"{name}.mcap"

    def plot(self, name: str) -> Path:
        return self.path / "plots" / f"{name}.png"

    def progress(self, stage: str) -> Path:
        """Folder from where an unfinished stage continues."""
        return self.path / "resume" / stage

    @property
    def scratch(self) -> Path:
        """Folder for temporary files; what a killed stage has left there goes when the next one begins."""
        path = self.path / "scratch"
        path.mkdir(parents=True, exist_ok=True)
        return path

    @contextmanager
    def lasting_scratch(self) -> Iterator[Path]:
        """Folder for files of this process from which the running stage continues, and with which they go; outside a
        stage a temporary one."""
        if self.running is None:
            with tempfile.TemporaryDirectory(dir=self.scratch) as name:
                yield Path(name)
            return
        path = self.progress(self.running) / f"files_{processes.rank()}"
        path.mkdir(parents=True, exist_ok=True)
        yield path

    def require_checkpoint(self, name: str, stage: str) -> Path:
        """Path of a checkpoint that ``stage`` writes; raises ``FileNotFoundError`` naming the stage to run."""
        path = self.checkpoint(name)
        if not path.is_dir():
            raise FileNotFoundError(f"{path} does not exist: run the stage {stage!r} on this folder first")
        return path

    def named_checkpoint(self, named: str, stage: str) -> Path:
        """The checkpoint of that name, or the folder so named if the run has none; see :meth:`require_checkpoint`."""
        path = Path(named)
        return path if path.is_dir() and not self.checkpoint(named).is_dir() else self.require_checkpoint(named, stage)

    def require_rollouts(self, name: str, stage: str) -> Path:
        """Path of a rollout file that ``stage`` writes; raises ``FileNotFoundError`` naming the stage to run."""
        path = self.rollouts(name)
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist: run the stage {stage!r} on this folder first")
        return path

    @property
    def is_new(self) -> bool:
        """Whether no run has been opened here yet."""
        return not (self.path / "config.yaml").exists()

    def open(self, config: Any, tasks: dict[str, str] | None = None, begin: Callable[[], None] | None = None) -> None:
        """Creates the folder, or checks that the one found was made with the same settings and tasks, and locks it for
        this process, until it ends or this object is gone. Reading needs no lock.

        Args:
            config: the settings, a dataclass.
            tasks: digest of each task, by name.
            begin: called in a new folder before it counts as one: interrupted it is called again.

        Raises:
            ValueError: if ``config.yaml`` exists and differs, naming the first settings that do, or a task has changed;
                if a file of the run is damaged.
            BlockingIOError: if another process runs on the folder, naming it.
            OSError: if less than :data:`MIN_FREE_GB` is free on the disk.
        """
        if not processes.is_main():
            return
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock = lock_folder(self.path)
        free_gb = shutil.disk_usage(self.path).free / 1e9
        if free_gb < MIN_FREE_GB:
            raise OSError(
                f"{self.path} has {free_gb:.2f} GB free, a run needs {MIN_FREE_GB} GB: free some or change --run-dir"
            )
        self.check_settings(config)
        for name in ("checkpoints", "rollouts", "plots", "stages"):
            (self.path / name).mkdir(exist_ok=True)
        if self.is_new:
            if self.noted("begun"):  # a beginning was interrupted, and it may have had other settings
                for left in (*(self.path / "stages").iterdir(), self.path / "begun.json"):
                    left.unlink()
            if begin is not None:
                begin()
        _write_atomically(
            self.path / "config.yaml", yaml.safe_dump(_plain(dataclasses.asdict(config)), sort_keys=False)
        )
        self._note_versions()
        self._note_tasks(tasks or {})

    def check_settings(self, config: Any) -> None:
        """Raises ``ValueError`` if a run was made here with other settings, naming the first of them: one that is
        gone comes before those that could be set as they were."""
        if self.is_new:
            return
        before, now = stored_settings(self.path / "config.yaml", type(config)), settings_of(config)
        for key in settings_gone(before, now):
            raise ValueError(
                f"{self.path} was made with {key}={before[key]!r}, which is no setting any more: use another "
                f"--run-dir (--begin-from {self.path} takes over the stages before), or the versions in its "
                "versions.json to continue"
            )
        changed = [key for key in now if before.get(key) != now[key] and key not in FREE]
        if changed:
            key, more = changed[0], f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
            raise ValueError(
                f"{self.path} was made with {key}={before.get(key)!r}, now {now[key]!r}{more}: "
                "use another --run-dir, or the same settings to continue"
            )

    def _note_tasks(self, tasks: dict[str, str]) -> None:
        """Notes the digests of the tasks in ``tasks.json``, once."""
        noted = self.noted("tasks")
        changed = [task for task, digest in tasks.items() if noted.get(task, digest) != digest]
        if changed:
            raise ValueError(
                f"{changed[0]} has changed since {self.path} was made: use another --run-dir, or the file as it was"
            )
        if tasks and not noted:
            self.note("tasks", tasks)

    def _note_versions(self) -> None:
        """Adds what runs now to ``versions.json`` if it is not what ran last."""
        path = self.path / "versions.json"
        try:
            noted = list(json.loads(path.read_text()))
        except (OSError, ValueError, TypeError):
            noted = []
        now = machine_versions()
        if not noted or noted[-1] != now:
            _write_atomically(path, json.dumps([*noted, now], indent=1) + "\n")

    def done(self, stage: str) -> bool:
        return (self.path / "stages" / stage).exists()

    def forget(self, stage: str) -> None:
        """Lets a stage, finished or not, run again from its beginning."""
        if not processes.is_main():
            return
        shutil.rmtree(self.progress(stage), ignore_errors=True)
        (self.path / "stages" / stage).unlink(missing_ok=True)
        begun = self.noted("begun")
        if stage in begun.get("stages", ()):
            self.note("begun", begun | {"stages": [name for name in begun["stages"] if name != stage]})

    def take_over(self, source: RunFolder, stages: Mapping[str, Iterable[str]]) -> None:
        """Copies what finished stages of another run have left, and what made them (``versions.json``); marks them
        finished here.

        Args:
            source: the other run's folder.
            stages: the files and folders of each, as patterns under it.
        """
        for patterns in stages.values():
            for path in (path for pattern in patterns for path in source.path.glob(pattern)):
                copy = self.path / path.relative_to(source.path)
                if path.is_dir():
                    shutil.copytree(path, copy, dirs_exist_ok=True)
                else:
                    shutil.copy2(path, copy)
        if (source.path / "versions.json").exists():
            shutil.copy2(source.path / "versions.json", self.path / "versions.json")
        lines = [line for line in source.read_metrics() if line["stage"] in stages]
        _write_atomically(self.metrics_path, "".join(json.dumps(line) + "\n" for line in lines))
        for name in stages:
            shutil.copy2(source.path / "stages" / name, self.path / "stages" / name)

    def note(self, name: str, values: Mapping[str, Any]) -> None:
        """Writes ``<name>.json``."""
        _write_atomically(self.path / f"{name}.json", json.dumps(_plain(values), indent=1) + "\n")

    def noted(self, name: str) -> dict[str, Any]:
        """What :meth:`note` wrote, nothing if it never did; raises ``ValueError`` if it is damaged."""
        path = self.path / f"{name}.json"
        return _read(path, json.loads) if path.exists() else {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Runs a stage and marks it finished at the end.

        What an earlier attempt has logged goes; a finished one's checkpoints, too, so that it begins anew, and if it
        ends before it has any, what was finished still is. Its loops bring back what belongs to the checkpoint from
        which they continue.
        """
        before: Callable[[], None] | None = None
        if processes.is_main():
            if self.done(name):
                before = self._as_it_was(name)
                self.forget(name)
            shutil.rmtree(self.path / "scratch", ignore_errors=True)
        processes.barrier()
        outer = self.running, self._started, self._seconds
        self.running, self._started, since = name, time.monotonic(), time.time()
        self.restore_stage(name, 0.0, [])
        try:
            yield
            processes.barrier()  # nobody reads or writes there any more
            if not processes.is_main():
                return
            seconds = self.stage_seconds()
            self.log(name, seconds=seconds)
            # Marked first: a crash in between leaves checkpoints that nobody reads.
            _write_atomically(self.path / "stages" / name, f"{seconds:.1f}\n")
            files = (self.path / "rollouts").glob("*.mcap")
            self.loggers.recordings(path for path in files if path.stat().st_mtime >= since)
            shutil.rmtree(self.progress(name), ignore_errors=True)
            shutil.rmtree(self.path / "scratch", ignore_errors=True)
        except BaseException:
            if before is not None and not any(path.is_file() for path in self.progress(name).rglob("*")):
                before()
            raise
        finally:
            self.running, self._started, self._seconds = outer

    def _as_it_was(self, name: str) -> Callable[[], None]:
        """What makes a stage as finished as it is now, once it was forgotten and nothing else has changed."""
        mark, begun, lines = self.path / "stages" / name, self.noted("begun"), self.read_metrics(name)
        text = mark.read_text()

        def restore() -> None:
            self.restore_stage(name, 0.0, lines)
            if begun:
                self.note("begun", begun)
            _write_atomically(mark, text)

        return restore

    def stage_seconds(self) -> float:
        """That the running stage has taken, in this process and in those that it continues."""
        return self._seconds + time.monotonic() - self._started

    def restore_stage(self, name: str, seconds: float, lines: Iterable[dict[str, Any]]) -> None:
        """Sets what the running stage has taken before this process, and its lines in ``metrics.jsonl``."""
        self._seconds = seconds
        if not processes.is_main():
            return
        kept = [line for line in self.read_metrics() if line["stage"] != name]
        _write_atomically(self.metrics_path, "".join(json.dumps(line) + "\n" for line in [*kept, *lines]))

    def log(self, stage: str, **values: Any) -> None:
        """Appends one line to ``metrics.jsonl``, and gives its numbers to the loggers."""
        if not processes.is_main():
            return
        values = _plain(values)
        with self.metrics_path.open("a") as file:
            file.write(json.dumps({"stage": stage} | values) + "\n")
        self.loggers.log(stage, values)

    def keep_traceback(self, error: BaseException) -> Path | None:
        """Writes ``error.txt``, the last traceback; None if the disk takes no more."""
        path = self.path / ("error.txt" if processes.is_main() else f"error_{processes.rank()}.txt")
        try:
            _write_atomically(path, "".join(traceback.format_exception(error)))
        except OSError:
            return None
        return path

    def start_logging(self, config: Any) -> None:
        """Gives what is logged from now on to the loggers ``config.logger``, too, until :attr:`loggers` are closed.

        Raises:
            ValueError: naming a logger that cannot start.
        """
        if not processes.is_main():
            return
        settings = {key: str(value) for key, value in _flat(_plain(dataclasses.asdict(config))).items()}
        self.loggers = Loggers.open(config.logger, self.path, settings)

    def read_metrics(self, stage: str | None = None) -> list[dict[str, Any]]:
        """The lines of ``metrics.jsonl``, of one stage if named; see :func:`read_metrics`."""
        if not self.metrics_path.exists():
            return []
        lines = read_metrics(self.path)
        return [line for line in lines if stage in (None, line["stage"])]


def settings_of(config: Any) -> dict[str, Any]:
    """All settings of a dataclass of them by their dotted names, as ``config.yaml`` holds them."""
    return _flat(_plain(dataclasses.asdict(config)))


def stored_settings(path: Path, kind: type) -> dict[str, Any]:
    """Those in a ``config.yaml``; what has become a setting of ``kind`` since then was at its default."""
    return settings_of(kind()) | _flat(_read(path, yaml.safe_load))


def settings_gone(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Names of those in ``before`` that ``now`` does not have and that did something: they were not off (0, false, none
    or empty), nor what :data:`_IDLE` names."""
    return [name for name, value in before.items() if name not in now and value and value != _IDLE.get(name)]


def _read(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    """The mapping in a file of the run."""
    try:
        found = parse(path.read_text())
    except (ValueError, yaml.YAMLError) as error:
        found = " ".join(str(error).split())
    if not isinstance(found, dict):
        raise ValueError(f"{path} cannot be read ({found}): restore it from a copy, or use another --run-dir")
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def _write_atomically(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)
