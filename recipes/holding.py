"""Holding what is solved: LOOP changes what a policy does everywhere, and its returns do not show what that costs where
there is nothing to win.

Sampled rollouts say little of the greedy policy, whom noise no longer helps past a place where it hesitates, and an
imagined one is right by and large. Exploration's greedy rollouts were real: on tasks that they solve the policy keeps
its means, and so it does on those of which imagination knows too little (``trust.py``); it learns from the others.
Leaving those tasks out would not do, for then they are forgotten.
"""

from __future__ import annotations

import warnings
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

import processes
from episodes import explored_at, round_of
from imagination import Imagination
from physics import exploring_actor
from run import Run
from trust import agreement
from updates import rows_of
from worldenv_trl import keys
from worldenv_trl.data import Episodes


class Hold:
    """Which groups of a wave are held, and what the policy that LOOP began with does there.

    Args:
        source: that policy's checkpoint, a copy of which is kept.
        models: suffix of the round, whose exploration is asked.
        imagination: where LOOP learns, which with ``post_train.trust`` is asked, too; None in the physics.

    Attributes:
        everything: whether all tasks are held, so that there is nothing to learn.
    """

    def __init__(self, run: Run, source: str, models: str, imagination: Imagination | None = None) -> None:
        policy, settings = run.policy(source).eval(), run.config.post_train
        self._actor = exploring_actor(run.config, policy, settings.scale_factor)
        shares = greedy_shares(run, models)
        solved, unknown = _enough(run, shares), list[int]()
        if imagination is not None and settings.trust and len(solved) < len(run.config.tasks):
            unknown = self._unknown(run, imagination, models, [task for task in shares if task not in solved])
        held, count = solved + unknown, len(run.config.tasks)
        self._tasks, self.everything = torch.tensor(held, dtype=torch.long), len(held) == count
        if len(solved) == count:
            warnings.warn(
                f"all tasks are held, so adapting and LOOP are left out: greedy exploration solved at least "
                f"{min(shares.values()):.2f} of each; a new run with --begin-from {run.folder.path} and "
                "--post-train.hold 0, or with a higher --post-train.hold-from, learns",
                stacklevel=2,
            )
        elif self.everything:
            warnings.warn(
                f"all tasks are held, {len(solved)} solved and {len(unknown)} unknown to imagination, so LOOP is left "
                f"out and the policy stays what {source} is; a new run with --begin-from {run.folder.path} and a lower "
                "--post-train.trust learns",
                stacklevel=2,
            )
        elif not held:
            warnings.warn(
                f"no task is held: greedy exploration solved at most {max(shares.values()):.2f} of one, and "
                f"--post-train.hold-from is {settings.hold_from:g}",
                stacklevel=2,
            )
        elif processes.is_main() and solved:
            print("held: " + ", ".join(f"{run.config.tasks[n]} ({shares[n]:.2f})" for n in solved))

    def _unknown(self, run: Run, imagination: Imagination, models: str, tasks: list[int]) -> list[int]:
        """Those of ``tasks`` of which imagination does not know enough, which is printed."""
        agreed = processes.on_main(lambda: agreement(run, imagination, models, tasks))
        unknown = [task for task in tasks if not agreed[task] >= run.config.post_train.trust]
        names = ", ".join(f"{run.config.tasks[task]} ({agreed[task]:.2f})" for task in unknown)
        if unknown and processes.is_main():
            print(f"imagination's verdicts and exploration's outcomes agree too little to learn from: {names}")
        return unknown

    def groups(self, wave: TensorDictBase) -> Tensor:
        """Bool [G]: the groups of a wave [G, N, T] whose task is held."""
        tasks = wave[keys.TASK_ID][:, 0, 0, 0]
        return torch.isin(tasks, self._tasks.to(tasks.device))

    @torch.no_grad()
    def refer(self, decisions: TensorDictBase) -> None:
        """Writes the reference's ``loc`` and ``scale`` [M, C, 7] into decisions [M], zeros and ones where not held."""
        held = decisions[keys.HELD].squeeze(-1).nonzero().squeeze(-1)
        loc = torch.zeros_like(decisions[keys.CHUNK])
        scale = torch.ones_like(loc)
        for rows in held.split(rows_of(decisions)) if len(held) else ():
            found: Any = self._actor.get_dist(decisions[rows].select(*self._actor.policy.in_keys))
            loc[rows], scale[rows] = found.loc, found.scale
        decisions[keys.REFERENCE_LOC], decisions[keys.REFERENCE_SCALE] = loc, scale


def all_held(run: Run, models: str) -> bool:
    """Whether LOOP holds every task of a round, so that there is nothing to learn and the policy stays as it is."""
    return bool(run.config.post_train.hold) and len(solved_tasks(run, models)) == len(run.config.tasks)


def solved_tasks(run: Run, models: str) -> list[int]:
    """The tasks of which greedy exploration solved enough to hold them."""
    return _enough(run, greedy_shares(run, models))


def greedy_shares(run: Run, models: str) -> dict[int, float]:
    """What greedy exploration solved of each task."""
    return solved_shares(explored_at(run, round_of(models), [0.0]))


def _enough(run: Run, shares: dict[int, float]) -> list[int]:
    return [task for task, share in shares.items() if share >= run.config.post_train.hold_from]


def solved_shares(episodes: Episodes) -> dict[int, float]:
    """By task id, the share of its episodes that reached the goal."""
    reached, tasks = episodes[keys.SUCCESS].flatten(1).any(-1).float(), episodes[keys.TASK_ID].squeeze(-1)
    return {task: reached[tasks == task].mean().item() for task in tasks.unique().tolist()}
