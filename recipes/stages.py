"""The machinery of stages: their order, and running all of them or one. It knows no stage; each is given to it."""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import tyro
from tqdm import tqdm

import processes
from beginning import beginning
from checks import check_config, check_shares, doubts
from command_line import INTERRUPTED, expected, in_options, refusals
from config import PRESETS, WorldEnvConfig
from libero_files import from_libero
from parts import Parts
from real_parts import parts_of
from run import Run
from run_folder import RunFolder
from task_names import with_tasks
from threads import check_threads, use_threads
from worldenv_trl.pretrained import saved_class
from worldenv_trl.scenes import load_task

Work = Callable[..., None]
"""``work(run, **options)``: what a stage does."""


SHARED = {"sft", "train_world_model", "train_reflector", "adapt", "post_train"}
"""Kinds of stages that all processes work on; the others are the main one's."""


_MAKES = {
    "sft": "policy",
    "adapt": "policy",
    "post_train": "policy",
    "train_world_model": "world_model",
    "train_reflector": "reflector",
}
"""The part that a kind of stage makes."""


@dataclass(frozen=True)
class Stage:
    name: str
    kind: str
    makes: str
    """What it leaves in the run folder; without it the stage counts as not finished."""
    options: Mapping[str, Any] = field(default_factory=dict)

    def finished_in(self, folder: RunFolder) -> bool:
        return folder.done(self.name) and (folder.path / self.makes).exists()


def plan(config: WorldEnvConfig) -> list[Stage]:
    """World-Env's Algorithm 1 as a list; a later round continues from the policy that the round before reached.

    A policy of commands for LIBERO's controller acts there alone: SFT is the last stage."""
    stages = [
        Stage("demonstrate", "demonstrate", "rollouts/demonstrations.mcap"),
        Stage("sft", "sft", "checkpoints/sft"),
    ]
    if from_libero(config) and config.demonstrate.actions == "stored":
        return stages
    if config.post_train.env == "tabletop":  # the upper bound needs neither world model nor reflector
        if config.post_train.hold:  # what is held is what exploration solved
            see = {"policy": "sft", "target": "explore"}
            stages.append(Stage("explore", "explore", "rollouts/explore.mcap", see))
        learn = {"source": "sft", "target": "post_train", "models": ""}
        judge = {"before": "sft", "after": "post_train", "models": None}
        stages.append(Stage("post_train", "post_train", "checkpoints/post_train", learn))
        return [*stages, Stage("evaluate", "evaluate", "metrics.jsonl", judge)]
    policy, previous, models = "sft", None, ""
    for number in range(1, config.rounds + 1):
        models = "" if number == 1 else f"_{number}"
        explored, world, reflector, improved = (
            f"{name}{models}" for name in ("explore", "world_model", "reflector", "post_train")
        )
        see = {"policy": policy, "target": explored}
        dream = {"target": world, "previous": previous, "rounds": number}
        score = {"target": reflector, "models": models, "rounds": number}
        stages += [
            Stage(explored, "explore", f"rollouts/{explored}.mcap", see),
            Stage(world, "train_world_model", f"checkpoints/{world}", dream),
            Stage(reflector, "train_reflector", f"checkpoints/{reflector}", score),
        ]
        if config.adapt.steps:
            adapted = f"adapted{models}"
            seen = {"source": policy, "target": adapted, "models": models}
            stages.append(Stage(adapted, "adapt", f"checkpoints/{adapted}", seen))
            policy = adapted
        learn = {"source": policy, "target": improved, "models": models}
        stages.append(Stage(improved, "post_train", f"checkpoints/{improved}", learn))
        policy, previous = improved, world
    options = {"before": "sft", "after": policy, "models": models}
    return [*stages, Stage("evaluate", "evaluate", "metrics.jsonl", options)]


def run_stages(run: Run, works: Mapping[str, Work]) -> None:
    """Runs what is not finished yet, and what learned from it before; ``works`` says what a kind of stage does."""
    stages = plan(run.config)
    for index, stage in enumerate(stages):
        if _finished(stage, run.folder):
            print(f"{stage.name}: finished, skipped")
            continue
        if run.folder.done(stage.name):
            _warn(f"{stage.name} was finished, and {run.folder.path / stage.makes} is gone: it runs again")
        _run(stage, works[stage.kind], run, stages[index + 1 :])


def run_alone(kind: str, work: Work, arguments: Sequence[str] | None = None, parts: Parts | None = None) -> None:
    """Runs one stage of a preset alone, from the beginning if it is finished, else from where it was interrupted; of
    several rounds, the first unfinished one.

    The stages after it, which learned from what it made before, count as not finished once it is.
    """
    config = parse(sys.argv[1:] if arguments is None else arguments, work.__module__)
    run = open_run(config, parts)
    with closing(run.folder.loggers), closing(run):
        rerun(kind, work, run)


def rerun(kind: str, work: Work, run: Run) -> None:
    """See :func:`run_alone`."""
    stages = plan(run.config)
    same = [index for index, stage in enumerate(stages) if stage.kind == kind]
    if not same:
        raise SystemExit(f"these settings have no stage {kind!r}: {', '.join(stage.name for stage in stages)}")
    index = next((index for index in same if not _finished(stages[index], run.folder)), same[-1])
    _run(stages[index], work, run, stages[index + 1 :])


def parse(arguments: Sequence[str], module: str = "__main__") -> WorldEnvConfig:
    """The settings of a command line; its help begins with what ``module`` says of itself."""
    return tyro.extras.overridable_config_cli(PRESETS, args=arguments, description=sys.modules[module].__doc__)


def open_run(config: WorldEnvConfig, parts: Parts | None = None) -> Run:
    """The run of checked settings, with the parts that they name unless others are given; what is wrong is said in one
    line."""
    with refusals():
        config = with_tasks(config)
        processes.join(config.device)
        chosen = parts_of(config) if parts is None else parts
        folder = RunFolder(config.run_dir)
        count = processes.size()
        processes.on_main(lambda: _check_and_open(config, chosen, folder, count))
        run = Run(config, folder, chosen)
        use_threads(config.num_threads)
        run.workers  # noqa: B018 - a cluster without room says so now
    return run


def _check_and_open(config: WorldEnvConfig, parts: Parts, folder: RunFolder, count: int) -> None:
    check_threads(config.num_threads)
    check_config(config, parts)
    for doubt in doubts(config):
        _warn(doubt)
    check_shares(config, count)
    check_made_of(plan(config), parts, folder)
    begun = beginning(config, plan(config), folder)
    if begun is not None:
        check_made_of(begun.stages, parts, begun.source)
    tasks = {task: load_task(task).digest for task in config.tasks}
    folder.open(config, tasks, begin=None if begun is None else lambda: begun.copy_to(folder))
    folder.start_logging(config)


def check_made_of(stages: Sequence[Stage], parts: Parts, folder: RunFolder) -> None:
    """Raises ``ValueError`` if a checkpoint of one of the stages is of a class that ``parts`` do not load."""
    for stage in (stage for stage in stages if stage.kind in _MAKES):
        name, made = _MAKES[stage.kind], saved_class(folder.path / stage.makes)
        known = getattr(parts, name).known
        if known and made is not None and made not in known:
            raise ValueError(
                f"{folder.path / stage.makes} holds {made}, and the run's {name.replace('_', ' ')} is "
                f"{' or '.join(known)} now: use another --run-dir, or the parts that it was made with"
            )


def _forget(later: Sequence[Stage], stage: Stage, run: Run) -> None:
    again = [each.name for each in later if run.folder.done(each.name)]
    for each in later:
        run.folder.forget(each.name)
    if again and processes.is_main():
        print(f"{', '.join(again)} learned from what {stage.name} made before: to be run again")


def _finished(stage: Stage, folder: RunFolder) -> bool:
    return processes.agreed(stage.finished_in(folder))


def _warn(message: Warning | str) -> None:
    if processes.is_main():
        tqdm.write(f"warning: {message}", file=sys.stderr)


def _run(stage: Stage, work: Work, run: Run, later: Sequence[Stage]) -> None:
    """Runs a stage, and lets ``later`` ones be run again; Ctrl-C ends the program with one line, wherever it strikes,
    and so does an expected error."""
    interrupted = threading.Event()

    def interrupt(number: int, frame: FrameType | None) -> None:
        interrupted.set()
        signal.default_int_handler(number, frame)

    here = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, interrupt) if here else None
    try:
        with run.folder.stage(stage.name), warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: _warn(message)
            if stage.kind in SHARED:
                work(run, **stage.options)
            else:
                processes.on_main(lambda: work(run, **stage.options))
            _forget(later, stage, run)
    except BaseException as error:
        if not interrupted.is_set():
            if isinstance(error, processes.FailedElsewhere):
                processes.end_quietly()
            if not isinstance(error, Exception) or not expected(error):
                raise
            kept = run.folder.keep_traceback(error)
            if not processes.speaks_first():
                processes.end_quietly()
            where = "" if kept is None else f" (stage {stage.name}; where it was raised: {kept})"
            raise SystemExit(f"error: {in_options(error)}{where}") from error
        # Libraries may have turned the KeyboardInterrupt into an error of their own.
        if not processes.is_main():
            raise SystemExit(1) from error
        message = f"interrupted in stage {stage.name}: the same command continues, finished stages are kept"
        print(f"\n{message}", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from error
    finally:
        if here:
            signal.signal(signal.SIGINT, before)
