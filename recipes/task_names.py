"""What a user may write for tasks on a command line: suites, tasks and files."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from config import WorldEnvConfig
from worldenv_trl.hdf5_file import SUFFIXES
from worldenv_trl.scenes import list_suites, list_tasks

SUITES = (*list_suites(), "starter")


def named_tasks(words: Sequence[str]) -> list[str]:
    """The tasks that suites, ``suite/name`` and paths of ``.bddl`` files mean, each once, in order.

    Raises:
        ValueError: for a word that cannot be any of them; whether the task or file is there is not checked.
    """
    if not words:
        raise ValueError(f"--tasks is empty: name suites ({', '.join(SUITES)}), tasks or .bddl files")
    names: list[str] = []
    for word in words:
        if word in SUITES:
            names += list_tasks(word)
        elif "/" in word or word.endswith(".bddl"):
            names.append(word)
        else:
            known = {task.split("/")[1]: task for suite in SUITES for task in list_tasks(suite)}
            close = difflib.get_close_matches(word, [*known, *SUITES], n=1, cutoff=0.5)
            hint = f"did you mean {known.get(close[0], close[0])!r}?" if close else f"suites are {', '.join(SUITES)}"
            raise ValueError(f"{word!r} is no suite, and tasks are written suite/name: {hint}")
    return list(dict.fromkeys(names))


def with_tasks(config: WorldEnvConfig) -> WorldEnvConfig:
    """The settings with a suite's tasks and the files of a folder, by name, in place of each suite and folder.

    Raises:
        ValueError: for a folder without LIBERO's files, and as :func:`named_tasks`.
    """
    tasks: list[str] = []
    for word in config.tasks:
        if word not in SUITES and Path(word).is_dir():
            tasks += _files_in(Path(word))
        else:
            tasks += [word] if word.endswith(SUFFIXES) else named_tasks([word])
    return config if tuple(tasks) == config.tasks else replace(config, tasks=tuple(tasks))


def _files_in(folder: Path) -> list[str]:
    files = sorted(str(path) for suffix in SUFFIXES for path in folder.glob(f"*{suffix}"))
    if not files:
        raise ValueError(
            f"tasks names the folder {folder}, which holds no file of LIBERO's (*_demo.hdf5): a suite's folder of its "
            "download does"
        )
    return files
