"""Success against real rollouts: on which initial states it is measured, how it is kept, and with what intervals.

A curve is a run folder with the lines ``learning`` in its ``metrics.jsonl`` and ``curve.json`` beside it;
``benchmarks/learning.py`` measures one, ``benchmarks/learning_plot.py`` draws several.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from config import WorldEnvConfig
from run_folder import RunFolder
from worldenv_trl.metrics import wilson_interval

STAGE, DESCRIPTION = "learning", "curve.json"
SPLITS, MODES = ("training", "validation"), ("greedy", "sampled")

VALIDATION_FROM = 1000
"""First validation state: a training state of a number far above ``train_states``, which no stage draws from. The same
whatever ``train_states`` is, and none of the held-out states, which are for the evaluation alone."""


def measured_states(config: WorldEnvConfig, count: int) -> dict[str, list[int]]:
    """Numbers of training initial states of every task on which success is measured, ascending.

    ``training``: up to ``count``, spread over the first ``train_states``, which demonstrations, exploration and LOOP
    draw from. ``validation``: ``count`` from :data:`VALIDATION_FROM` on.

    Raises:
        ValueError: if the two overlap or ``count`` is below 1.
    """
    if config.train_states > VALIDATION_FROM or config.demonstrate.episodes_per_task > VALIDATION_FROM:
        raise ValueError(
            f"train_states and demonstrate.episodes_per_task must be at most {VALIDATION_FROM}, where validation "
            f"states begin, got {config.train_states} and {config.demonstrate.episodes_per_task}"
        )
    if count < 1:
        raise ValueError(f"states must be at least 1, got {count}")
    seen = torch.linspace(0, config.train_states - 1, min(count, config.train_states)).long().tolist()
    return {"training": seen, "validation": list(range(VALIDATION_FROM, VALIDATION_FROM + count))}


def measured_iterations(iterations: int, growth: float) -> list[int]:
    """0, 1, then each time ``growth`` times as many, and the last.

    Raises:
        ValueError: if ``growth`` is not above 1.
    """
    if not growth > 1:
        raise ValueError(f"growth must be above 1, got {growth}")
    found = [0, 1]
    while found[-1] < iterations:
        found.append(min(max(found[-1] + 1, round(growth * found[-1])), iterations))
    return found


def log_point(
    folder: RunFolder, iterations: int, rollouts: int, split: str, mode: str, outcomes: dict[str, torch.Tensor]
) -> None:
    """Appends a point: one line for each task and one for all, with Wilson intervals.

    Args:
        folder: of the curve.
        iterations, rollouts: that LOOP has seen.
        split: ``training`` or ``validation``.
        mode: ``greedy`` or ``sampled``.
        outcomes: success bool ``[K]`` on the states of each task.
    """
    for task, success in ({"all": torch.cat(list(outcomes.values()))} | outcomes).items():
        low, high = wilson_interval(int(success.sum()), len(success))
        line = {"iterations": iterations, "rollouts": rollouts, "split": split, "mode": mode, "task": task}
        line |= {"success": success.float().mean().item(), "low": low, "high": high, "episodes": len(success)}
        if task != "all":
            line["outcomes"] = "".join("01"[reached] for reached in success.tolist())
        folder.log(STAGE, **line)


@dataclass(frozen=True)
class Curve:
    """One seed of one variant.

    ``points[split, mode][rollouts]`` is success bool ``[K]`` on the states of all tasks, in the order of ``tasks``,
    which names the task of each ``[K]`` for a split. ``correlations`` are those of returns and truth within the groups
    of each wave that had both successes and failures, and how many these were.
    """

    label: str
    tasks: dict[str, np.ndarray]
    points: dict[tuple[str, str], dict[int, np.ndarray]]
    correlations: list[tuple[float, int]]


def describe(folder: RunFolder, description: dict[str, Any]) -> None:
    """Writes ``curve.json``, or checks that the one found says the same.

    Raises:
        ValueError: if it does not.
    """
    path, text = folder.path / DESCRIPTION, json.dumps(description, indent=1) + "\n"
    if path.exists() and json.loads(path.read_text()) != json.loads(text):
        raise ValueError(f"{folder.path} holds another curve, see {path}: use another --run-dir")
    path.write_text(text)


def read_curve(path: Path) -> Curve:
    """A curve, as far as it has been measured.

    Raises:
        FileNotFoundError: if the folder holds none.
    """
    folder, about = RunFolder(path), path / DESCRIPTION
    lines = folder.read_metrics(STAGE)
    if not about.exists() or not any("split" in line for line in lines):
        raise FileNotFoundError(f"{path} holds no learning curve: measure one with benchmarks/learning.py")
    parts: dict[tuple[str, str], dict[int, dict[str, np.ndarray]]] = {}
    for line in lines:
        if "outcomes" in line:
            point = parts.setdefault((line["split"], line["mode"]), {}).setdefault(line["rollouts"], {})
            point[line["task"]] = np.array([letter == "1" for letter in line["outcomes"]])
    tasks: dict[str, np.ndarray] = {}
    points: dict[tuple[str, str], dict[int, np.ndarray]] = {}
    for (split, mode), measured in parts.items():
        first = next(iter(measured.values()))
        names = list(first)
        tasks[split] = np.concatenate([np.full(len(first[name]), name) for name in names])
        points[split, mode] = {
            rollouts: np.concatenate([point[name] for name in names])
            for rollouts, point in measured.items()
            if point.keys() >= set(names)  # a crash may cut a point short
        }
    correlations = [(line["correlation"], line["mixed_groups"]) for line in lines if "correlation" in line]
    return Curve(json.loads(about.read_text())["label"], tasks, points, correlations)


def common(curves: Sequence[Curve], split: str, mode: str) -> dict[int, np.ndarray]:
    """``{rollouts: [S, K]}`` where all of S curves of a variant have been measured.

    Raises:
        ValueError: if they were measured on different states.
    """
    if any(list(curve.tasks.get(split, ())) != list(curves[0].tasks.get(split, ())) for curve in curves):
        raise ValueError(f"the curves labelled {curves[0].label!r} were measured on different numbers of states")
    each = [curve.points.get((split, mode), {}) for curve in curves]
    return {
        rollouts: np.stack([points[rollouts] for points in each])
        for rollouts in sorted(set[int](each[0]).intersection(*each[1:]))
    }


def bootstrap_interval(
    values: np.ndarray, strata: np.ndarray, *, confidence: float = 0.95, draws: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap of a mean over seeds and initial states, both drawn again (Owen, "The pigeonhole
    bootstrap", 2007).

    With a few seeds it is too narrow, with one it covers the states alone.

    Args:
        values: ``[S, K]`` of S seeds on the same K states.
        strata: ``[K]`` the task of each state; as many of each are drawn as there are.

    Keyword Args:
        confidence: of the interval.
        draws: of the bootstrap.
        seed: of the draws.

    Returns:
        ``(low, high)``.
    """
    generator, (seeds, states) = np.random.default_rng(seed), values.shape
    by_seed = generator.multinomial(seeds, np.full(seeds, 1 / seeds), draws)  # [B, S]
    by_state = np.zeros((draws, states))
    for stratum in np.unique(strata):
        rows = np.flatnonzero(strata == stratum)
        by_state[:, rows] = generator.multinomial(len(rows), np.full(len(rows), 1 / len(rows)), draws)
    means = ((by_seed @ values.astype(float)) * by_state).sum(-1) / (seeds * states)
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)
