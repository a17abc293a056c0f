"""A run that begins with what another one has finished: ``--begin-from RUN``.

The new folder gets copies of RUN's checkpoints, recordings and figures of all stages up to the first that depends on a
setting which is another one here; from there on it runs by itself. So what LOOP makes of other settings is compared in
one pair of models, and no folder mixes settings. ``begun.json`` says what came from where.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from config import WorldEnvConfig
from run_folder import FREE, RunFolder, settings_gone, settings_of, stored_settings
from worldenv_trl.record.mcap.index import MAGIC
from worldenv_trl.scenes import load_task

if TYPE_CHECKING:
    from stages import Stage

_ANYWHERE = FREE | {"rounds"}  # later rounds leave the earlier ones as they are
DEPENDS_ON: dict[str, tuple[str, ...]] = {
    "demonstrate": ("demonstrate",),
    "sft": ("sft", "real_size"),
    "explore": ("explore", "scale_floor", "scale_share", "post_train.ratio_level"),
    "train_world_model": ("world_model",),
    "train_reflector": ("reflector",),
    "adapt": (
        "adapt",
        "post_train.hold",
        "post_train.hold_from",
        "post_train.lora_rank",
        "post_train.scale_factor",
    ),
    "post_train": ("adapt", "post_train", "scale_floor", "scale_share", "evaluate.num_envs"),
}
"""Settings, or sections of them, that a kind of stage depends on besides those of the stages before it and those of the
whole run: its tasks, seed, cameras and so on."""
_SWITCHES = {
    "adapt": "adapt.steps",
    "adapt.correct_lr": "adapt.correct_steps",
    "post_train.hold_from": "post_train.hold",
    "post_train.probe_contexts": "post_train.probe_every",
}
"""Settings, or sections of them, that are not read while another one is 0; that one always counts."""


@dataclass(frozen=True)
class Beginning:
    """What a new run takes over."""

    source: RunFolder
    stages: tuple[Stage, ...]
    why: str
    """No more than these."""

    def copy_to(self, folder: RunFolder) -> None:
        names = [stage.name for stage in self.stages]
        folder.note("begun", {"run": str(self.source.path.resolve()), "stages": names})
        try:
            folder.take_over(self.source, {stage.name: _left_by(stage) for stage in self.stages})
        except KeyboardInterrupt:
            print(f"not all of {self.source.path} has come over: the same command begins again", file=sys.stderr)
            raise
        print(self)

    def __str__(self) -> str:
        names = ", ".join(stage.name for stage in self.stages)
        return f"{names}: as in {self.source.path}" + (f" ({self.why})" if self.why else "")


def beginning(config: WorldEnvConfig, stages: Sequence[Stage], folder: RunFolder) -> Beginning | None:
    """What ``folder`` would take over from ``begin_from``; None for a run that has begun, or where nothing is named.

    Args:
        config: of the run.
        stages: its plan.
        folder: its folder; nothing is written.

    Raises:
        FileNotFoundError: if ``begin_from`` is no run folder.
        ValueError: if it is the run's own folder, or the run there has begun otherwise; if nothing can be taken from
            it, and why.
    """
    if config.begin_from is None:
        return None
    source = RunFolder(config.begin_from)
    if source.path.resolve() == folder.path.resolve():
        raise ValueError(f"begin_from is the run_dir itself, {source.path}: name a new folder for the run")
    if not folder.is_new:  # the other run is not needed any more
        if folder.noted("begun").get("run") != str(source.path.resolve()):
            raise ValueError(
                f"{folder.path} holds a run that did not begin with {source.path}: use another --run-dir, or leave "
                "begin_from out"
            )
        return None
    if source.is_new:
        raise FileNotFoundError(f"begin_from: {source.path} is no run folder, it holds no config.yaml")
    taken, why = stages_in_common(config, stages, source)
    if not taken:
        raise ValueError(f"begin_from: nothing of {source.path} can be taken, for {why}")
    return Beginning(source, tuple(taken), why)


def stages_in_common(config: WorldEnvConfig, stages: Sequence[Stage], source: RunFolder) -> tuple[list[Stage], str]:
    """The first stages, finished in ``source``, of which all that they depend on is the same there, and why no more.
    What evaluates is never among them."""
    before = stored_settings(source.path / "config.yaml", type(config))
    now, noted = settings_of(config), source.noted("tasks")
    for task in config.tasks:
        if noted.get(task) not in (None, load_task(task).digest):
            return [], f"{task} has changed since it was made"
    different = [*settings_gone(before, now), *(name for name in now if before.get(name) != now[name])]
    taken: list[Stage] = []
    read, unread = _of_the_run(before | now), _switched_off(now) | {"world_model.refit_steps"}
    for stage in (stage for stage in stages if stage.kind != "evaluate"):
        read |= set(DEPENDS_ON[stage.kind])
        if stage.kind == "sft" and config.parts == "real-size":
            read.add("post_train.lora_rank")  # of adapters that these parts are made with
        if stage.options.get("previous") is not None:
            unread.discard("world_model.refit_steps")  # a later round's model is the first to be refitted
        changed = [name for name in different if name not in unread and {name, name.split(".")[0]} & read]
        if changed:
            name = changed[0]
            here = f"and {now[name]!r} here" if name in now else "and no setting any more"
            return taken, f"{stage.name} is of {name}={before.get(name)!r} there {here}"
        if not stage.finished_in(source):
            return taken, f"{stage.name} is not finished there"
        made = source.path / stage.makes
        if made.suffix == ".mcap" and _is_cut_off(made):
            return taken, f"{stage.name} is cut off there: recipes/repair.py {made} says what is left"
        taken.append(stage)
    return taken, ""


def _is_cut_off(recording: Path) -> bool:
    with recording.open("rb") as file:
        file.seek(max(0, recording.stat().st_size - len(MAGIC)))
        return file.read() != MAGIC


def _of_the_run(settings: Mapping[str, Any]) -> set[str]:
    """Settings that every stage depends on: those of no stage."""
    of_stages = {name.split(".")[0] for names in DEPENDS_ON.values() for name in names} | {"evaluate"}
    return {name for name in settings if "." not in name and name not in of_stages | _ANYWHERE}


def _switched_off(settings: Mapping[str, Any]) -> set[str]:
    """Settings without effect where others are what they are."""
    by = {name: _SWITCHES.get(name, _SWITCHES.get(name.split(".")[0], name)) for name in settings}
    return {name for name, switch in by.items() if switch != name and not settings[switch]}


def _left_by(stage: Stage) -> list[str]:
    """Patterns of what a stage leaves, and the iterations of LOOP that were recorded."""
    numbers = ("[0-9]" * digits for digits in (3, 4, 5)) if stage.kind == "post_train" else ()
    return [stage.makes, *(f"rollouts/{stage.name}_{number}.mcap" for number in numbers)]
