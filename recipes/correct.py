"""The policy is taught where its hand has to go, by what exploration found out.

Of two demonstrations a policy learns to aim centimetres beside the thing in one picture of twelve, and to follow its
aim four fifths of the way. Noise succeeds there once in a while: then the place is known, of that initial state, and
every other rollout from there, led to it, is a demonstration (:func:`~worldenv_trl.data.corrected_samples`). LOOP knows
of no place, but whether a rollout ended well. The demonstrations stay a part of each batch, and so does what greedy
rollouts that succeed have done, or what is not corrected would be forgotten.

Part of the stage ``adapt``, before the world model's frames are shown.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import Parameter

import processes
from episodes import explored_at, quiet_factors, recorded_episodes, round_of
from holding import solved_tasks
from run import Run
from sft import cloning, decision_weights, lowest_heights, train
from worldenv_trl import keys
from worldenv_trl.data import (
    Episodes,
    corrected_samples,
    gripper_changes,
    policy_samples,
    until_reached,
    with_images,
)
from worldenv_trl.policies import Policy

_SHARES = (0.4, 0.4, 0.2)  # of a task: demonstrations, corrected, kept


def correct(run: Run, policy: Policy, parameters: list[Parameter], models: str) -> None:
    """``adapt.correct_steps`` updates of a policy's ``parameters`` by what a round explored; none where every task in
    which the gripper opens or closes is solved, or there is none: that is printed."""
    settings = run.config.adapt
    if not settings.correct_steps:
        return
    lessons = Corrections(run, round_of(models))
    nothing = ""
    if not lessons.tasks:
        nothing = "no explored rollout that reaches its goal opens or closes the gripper"
    elif lessons.tasks <= set(solved_tasks(run, models)):
        nothing = "every task whose successes open or close the gripper is solved"
    if nothing:
        if processes.is_main():
            print(f"adapt: nothing to correct, {nothing}")
        return
    if processes.is_main():
        print(f"adapt: corrected from {lessons.told} initial states, {len(lessons)} samples")
    loss = cloning(policy, run)
    steps, rate = settings.correct_steps, settings.correct_lr
    train(policy, loss, lessons, parameters, steps, rate, run, "correct", stage="adapted" + models)


class Corrections:
    """Demonstrations, explored rollouts led to where others took hold, and what greedy ones that succeed have done: two
    parts, two parts and one of each task, as far as it has them.

    Attributes:
        tasks: numbers of the tasks in which something is corrected.
        told: how many initial states a place is known of.
        lowest: see :class:`~sft.Lessons`.
    """

    def __init__(self, run: Run, number: int) -> None:
        config, length = run.config, run.config.chunk_length
        factors = quiet_factors(config)
        explored = until_reached(explored_at(run, number, factors))
        demonstrated = recorded_episodes(run, number)[0]
        everything, first = Episodes.cat([demonstrated, explored]), len(demonstrated)
        self._episodes = everything.through(config.sft.cameras or config.cameras)
        noise = torch.tensor(factors).repeat_interleave(len(explored) // len(factors))  # as many of each
        task = explored[keys.TASK_ID].squeeze(-1)
        rows = torch.isin(task, torch.tensor(taking_tasks(explored), dtype=task.dtype)).nonzero().squeeze(-1)
        corrected = corrected_samples(self._episodes[first + rows], noise[rows], length)
        corrected["episode"] = first + rows[corrected["episode"]]
        greedy = torch.cat([torch.zeros(first, dtype=torch.bool), noise == 0])
        kept = greedy & self._episodes["success"].any(1)
        parts = [self._all(torch.arange(len(kept)) < first, length), corrected]
        parts += [self._all(kept, length)] if kept.any() else []
        tasks = [self._episodes[keys.TASK_ID][part["episode"], 0] for part in parts]
        self.tasks = set(tasks[1].tolist())
        self.told = len(self._episodes[keys.CONTEXT_ID][corrected["episode"], 0].unique())
        weights = []
        for part, task, share in zip(parts, tasks, _SHARES, strict=False):
            weight = torch.zeros(len(part), dtype=torch.double)
            for each in task.unique():
                rows = (task == each).nonzero().squeeze(-1)
                weight[rows] = share * decision_weights(part[rows], length, config.sft.decision_share).double()
            weights.append(weight)
        self._samples, self._weights = torch.cat(parts), torch.cat(weights)
        texts = [self._episodes.instructions[row] for row in parts[0]["episode"].tolist()]
        self.lowest = lowest_heights(texts, parts[0][keys.STATE])

    def _all(self, of: Tensor, chunk_length: int) -> TensorDict:
        """Samples of every executed step of the episodes ``of``, bool [R], at least one of them."""
        rows = of.nonzero().squeeze(-1)
        out = policy_samples(self._episodes[rows], chunk_length, images=False)
        return out.set("episode", rows[out["episode"]])

    def __len__(self) -> int:
        return len(self._samples)

    def draw(self, count: int) -> Tensor:
        return torch.multinomial(self._weights, count, replacement=True)

    def __getitem__(self, rows: Tensor) -> TensorDictBase:
        samples: Any = self._samples[rows]
        return with_images(self._episodes, samples)


def taking_tasks(episodes: Episodes) -> list[int]:
    """Tasks of which at least half of the episodes that reach the goal tell the gripper otherwise: noise alone does so
    now and then where nothing is taken hold of."""
    reached, task = episodes["success"].any(1), episodes[keys.TASK_ID].squeeze(-1)
    changes = gripper_changes(episodes).any(1)[reached].float()
    return [each for each in task[reached].unique().tolist() if changes[task[reached] == each].mean() >= 0.5]
