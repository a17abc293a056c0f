"""Success on held-out initial states, by how far they lie from the nearest demonstration.

``python recipes/benchmarks/coverage.py runs/improve runs/another``: from what the stage ``evaluate`` recorded, nothing
is rolled out. The held-out states of a task are cut into parts of one size, nearest first; runs that are taken together
must share demonstrations and states. Distances are those of the things that the goal names
(``scenes.layout_distances``), in standard deviations of the training states.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

from command_line import at_least, refusals
from gather_evidence import read_config
from physics import reached_goal
from run_folder import RunFolder
from worldenv_trl import keys
from worldenv_trl.context_ids import UNKNOWN_CONTEXT, parts_of
from worldenv_trl.metrics import wilson_interval
from worldenv_trl.record import read_rollouts
from worldenv_trl.report import RunRecord
from worldenv_trl.scenes import goal_places, layout_distances, load_task


@dataclass(frozen=True)
class Settings:
    """What is compared."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs whose stage ``evaluate`` is done."""
    policies: tuple[str, ...] = ("sft", "post_train")
    """Checkpoints that were evaluated."""
    parts: int = 4
    """Into which the held-out states of a task are cut."""


def main(settings: Settings) -> None:
    with refusals():
        at_least(1, parts=settings.parts)
        if not settings.runs or not settings.policies:
            raise ValueError("name one run folder and one of --policies at least")
        found = [read_run(path, settings.policies) for path in settings.runs]
        tasks = list(found[0].distances)
        for path, one in zip(settings.runs[1:], found[1:], strict=True):
            if any(not np.array_equal(one.distances.get(task, []), found[0].distances[task]) for task in tasks):
                raise ValueError(f"{path} has other demonstrations or held-out states than {settings.runs[0]}")
    parts = [f"part {number + 1}" for number in range(settings.parts)]
    print(f"| task | policy | {' | '.join(parts)} |\n|{'---|' * (2 + len(parts))}")
    for task in tasks:
        cut = np.array_split(found[0].distances[task].argsort(kind="stable"), settings.parts)
        far = [f"{found[0].distances[task][rows].mean():.2f}" for rows in cut]
        print(f"| {task} | distance | {' | '.join(far)} |")
        for policy in settings.policies:
            success = np.stack([one.success[policy, task] for one in found])
            print(f"| | {policy} | {' | '.join(_rate(success[:, rows]) for rows in cut)} |")


@dataclass(frozen=True)
class Covered:
    """Of a run: distances [N] of each task's held-out states from the nearest demonstration, and success bool [N] by
    policy and task."""

    distances: dict[str, np.ndarray]
    success: dict[tuple[str, str], np.ndarray]


def read_run(path: Path, policies: tuple[str, ...]) -> Covered:
    """Reads what ``demonstrate`` and ``evaluate`` have recorded.

    Raises:
        FileNotFoundError: naming a stage that has not run.
        ValueError: for demonstrations without a numbered state, or policies that were evaluated on different states.
    """
    config, folder = read_config(RunRecord.read(path), 1), RunFolder(path)
    shown = _outcomes(folder.require_rollouts("demonstrations", "demonstrate"))
    if UNKNOWN_CONTEXT in shown:
        raise ValueError(f"{path}: its demonstrations do not say which initial states they begin at")
    evaluated = {
        policy: _outcomes(folder.require_rollouts(f"evaluate_physics_{policy}", "evaluate")) for policy in policies
    }
    if len({tuple(outcomes) for outcomes in evaluated.values()}) > 1:
        raise ValueError(f"{path}: {', '.join(policies)} were not evaluated on the same states")
    distances, success = dict[str, np.ndarray](), dict[tuple[str, str], np.ndarray]()
    for number, name in enumerate(config.tasks):
        task = load_task(name)
        trained = goal_places(task, task.init_states("train", config.train_states))
        for policy, outcomes in evaluated.items():
            success[policy, name] = np.array([*_of_task(outcomes, number).values()])
        rows = list(_of_task(evaluated[policies[0]], number))
        held_out = goal_places(task, task.init_states("test", 1 + max(rows))[rows])
        distances[name] = layout_distances(held_out, trained[list(_of_task(shown, number))], trained).min(1)
    return Covered(distances, success)


def _outcomes(path: Path) -> dict[int, bool]:
    """Whether the episode from each initial state reached the goal, in the order of their numbers."""
    rollouts = read_rollouts(path, keys=[keys.CONTEXT_ID, ("next", keys.SUCCESS), keys.MASK])
    reached = reached_goal(rollouts).flatten().tolist()
    return dict(sorted(zip(rollouts[keys.CONTEXT_ID][..., 0, 0].flatten().tolist(), reached, strict=True)))


def _of_task(outcomes: dict[int, bool], task: int) -> dict[int, bool]:
    """Those of one task, by the index of the state in its split."""
    return {parts_of(number)[2]: each for number, each in outcomes.items() if parts_of(number)[0] == task}


def _rate(success: np.ndarray) -> str:
    low, high = wilson_interval(int(success.sum()), success.size)
    return f"{100 * success.mean():.1f} [{100 * float(low):.0f}, {100 * float(high):.0f}]"


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
