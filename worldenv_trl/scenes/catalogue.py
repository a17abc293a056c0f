"""The catalogue of tasks: four suites of ten, the starter tasks, and any BDDL file."""

from __future__ import annotations

import difflib
from functools import cache
from pathlib import Path

from worldenv_trl.hdf5_file import SUFFIXES
from worldenv_trl.scenes.files import FileTask, load_bddl
from worldenv_trl.scenes.libero import load_libero

__all__ = ["SUITES_FOLDER", "list_suites", "list_tasks", "load_task"]

SUITES_FOLDER = Path(__file__).parent / "suites"
STARTER = "starter"
_MAX_STEPS = {STARTER: 72, "spatial": 120, "object": 120, "goal": 150, "long": 260}


def list_suites() -> list[str]:
    """Names of the benchmark's suites; the three ``starter`` tasks of the recipes' presets stand beside them."""
    return [suite for suite in _MAX_STEPS if suite != STARTER]


def list_tasks(suite: str) -> list[str]:
    """Names of a suite's tasks, in alphabetical order; raises ``ValueError`` for an unknown suite."""
    if suite not in _MAX_STEPS:
        raise ValueError(f"unknown suite {suite!r}: it must be one of {', '.join([*list_suites(), STARTER])}")
    return [f"{suite}/{path.stem}" for path in sorted((SUITES_FOLDER / suite).glob("*.bddl"))]


def load_task(name: str | Path) -> FileTask:
    """The task called ``suite/name``, or that of a file ``path.bddl`` or of LIBERO's demonstrations, ``path.hdf5``.

    Its standard initial states are those stored beside the file, ``path.npz``, if there are any
    (``recipes/init_states.py`` makes them); all others are drawn when they are asked for.

    Raises:
        TypeError: for what is no name.
        ValueError: with the closest names for an unknown task; for a file that cannot be read, laid out or judged.
        FileNotFoundError: if there is no such file.
        ImportError: for demonstrations, without h5py.
    """
    if not isinstance(name, str | Path):
        raise TypeError(f"a task is called by its name or file, got {name!r}: try 'starter/open_the_top_drawer'")
    if str(name).endswith(".bddl"):
        return load_bddl(name, states=Path(name).with_suffix(".npz"))
    if str(name).endswith(SUFFIXES):
        return load_libero(name)
    if name in _MAX_STEPS:
        raise ValueError(f"{name!r} is a suite: name tasks of it, for instance {list_tasks(str(name))[0]!r}")
    if name not in _known():
        close = difflib.get_close_matches(str(name), _known(), n=1, cutoff=0.3)
        hint = (
            f"did you mean {close[0]!r}?"
            if close
            else f"tasks are called suite/name, suites are {', '.join(_MAX_STEPS)}"
        )
        raise ValueError(f"unknown task {name!r}: {hint}")
    return _load(str(name))


@cache
def _known() -> tuple[str, ...]:
    return tuple(name for suite in _MAX_STEPS for name in list_tasks(suite))


@cache
def _load(name: str) -> FileTask:
    suite, stem = name.split("/")
    path = SUITES_FOLDER / suite / f"{stem}.bddl"
    return load_bddl(
        path,
        name=name,
        suite=suite,
        max_steps=_MAX_STEPS[suite],
        states=path.with_suffix(".npz"),
    )
