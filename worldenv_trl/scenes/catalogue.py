"""The catalogue of tasks: four suites of ten, the starter tasks, and any BDDL file."""

from __future__ import annotations

import difflib
from functools import cache
from pathlib import Path

from worldenv_trl.scenes.files import load_bddl
from worldenv_trl.scenes.starter import STARTER_TASKS
from worldenv_trl.scenes.starter import SUITE as STARTER
from worldenv_trl.scenes.tasks import Task

__all__ = ["SUITES_FOLDER", "list_suites", "list_tasks", "load_task"]

SUITES_FOLDER = Path(__file__).parent / "suites"
_MAX_STEPS = {"spatial": 120, "object": 120, "goal": 150, "long": 260}  # half as long again as the expert's slow ones
_FIRST_ID = 100


def list_suites() -> list[str]:
    """Names of the benchmark's suites; the three ``starter`` tasks of the recipes' presets stand beside them."""
    return list(_MAX_STEPS)


def list_tasks(suite: str) -> list[str]:
    """Names of a suite's tasks, in the order of their ``task_id``; raises ``ValueError`` for an unknown suite."""
    if suite == STARTER:
        return [task.name for task in STARTER_TASKS]
    if suite not in _MAX_STEPS:
        raise ValueError(f"unknown suite {suite!r}: it must be one of {', '.join([*_MAX_STEPS, STARTER])}")
    return [f"{suite}/{path.stem}" for path in sorted((SUITES_FOLDER / suite).glob("*.bddl"))]


def load_task(name: str | Path) -> Task:
    """The task called ``suite/name``, or that of a file ``path.bddl``.

    Raises:
        ValueError: with the closest names for an unknown task; for a file that cannot be read, laid out or judged.
        FileNotFoundError: if there is no such file.
    """
    if str(name).endswith(".bddl"):
        return load_bddl(name)
    if name not in _known():
        close = difflib.get_close_matches(str(name), _known(), n=1, cutoff=0.3)
        hint = f"did you mean {close[0]!r}?" if close else f"known tasks: {', '.join(_known())}"
        raise ValueError(f"unknown task {name!r}: {hint}")
    return _load(str(name))


@cache
def _known() -> tuple[str, ...]:
    return tuple(name for suite in (*_MAX_STEPS, STARTER) for name in list_tasks(suite))


@cache
def _load(name: str) -> Task:
    suite, stem = name.split("/")
    if suite == STARTER:
        return next(task for task in STARTER_TASKS if task.name == name)
    path = SUITES_FOLDER / suite / f"{stem}.bddl"
    return load_bddl(
        path,
        name=name,
        suite=suite,
        task_id=_FIRST_ID + _known().index(name),
        max_steps=_MAX_STEPS[suite],
        states=path.with_suffix(".npz"),
    )
