"""Holding what is solved: LOOP changes what a policy does everywhere, and its returns do not show what that costs where
there is nothing to win.

Sampled rollouts say little of the greedy policy, whom noise no longer helps past a place where it hesitates, and an
imagined one is right by and large. Exploration's greedy rollouts were real: on tasks that they solve the policy keeps
its means, and it learns from the others. Leaving those tasks out would not do, for then they are forgotten.
"""

from __future__ import annotations

import warnings
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from episodes import recorded_episodes
from explore import waves_per_scale
from physics import exploring_actor
from run import Run
from updates import rows_at_once
from worldenv_trl import keys
from worldenv_trl.data import Episodes
from worldenv_trl.devices import device_of, to_device
from worldenv_trl.language import instructions_of
from worldenv_trl.row_texts import row_texts


class Hold:
    """Which groups of a wave are held, and what the policy that LOOP began with does there.

    Args:
        source: that policy's checkpoint, a copy of which is kept.
        models: suffix of the round, whose exploration is asked.
    """

    def __init__(self, run: Run, source: str, models: str) -> None:
        policy = run.policy(source).eval()
        self._actor = exploring_actor(run.config, policy, run.config.post_train.scale_factor)
        shares = solved_shares(greedy_exploration(run, int(models.removeprefix("_") or 1)))
        self._tasks = torch.tensor(
            [task for task, share in shares.items() if share >= run.config.post_train.hold_from], dtype=torch.long
        )
        if len(self._tasks) == len(run.config.tasks):
            warnings.warn(
                f"all tasks are held, so nothing is learned: greedy exploration solved at least "
                f"{min(shares.values()):.2f} of each; pass --post-train.hold 0, or a higher --post-train.hold-from",
                stacklevel=2,
            )

    def groups(self, wave: TensorDictBase) -> Tensor:
        """Bool [G]: the groups of a wave [G, N, T] whose task is held."""
        tasks = wave[keys.TASK_ID][:, 0, 0, 0]
        return torch.isin(tasks, self._tasks.to(tasks.device))

    @torch.no_grad()
    def refer(self, wave: TensorDictBase, held: Tensor) -> None:
        """Writes ``held`` and the reference into a wave [G, N, T] of whose groups ``held`` [G] are held."""
        policy, device = self._actor.policy, wave[keys.CHUNK].device
        rows = (wave[keys.MASK] & held[:, None, None]).flatten()
        wave[keys.HELD] = rows.view(*wave.shape, 1)
        found = {keys.REFERENCE_LOC: torch.zeros_like(wave[keys.CHUNK]).flatten(0, 2)}
        found[keys.REFERENCE_SCALE] = torch.ones_like(found[keys.REFERENCE_LOC])
        decisions = wave.select(*policy.in_keys).reshape(-1)[rows]
        if len(decisions):
            decisions.set(keys.INSTRUCTION, row_texts(instructions_of(decisions)))
            pixels = sum(value[0].numel() for value in decisions["observation"].values() if value.dtype == torch.uint8)
            parts: list[Any] = [
                self._actor.get_dist(to_device(part, device_of(policy)))
                for part in decisions.split(rows_at_once(pixels, device_of(policy).type))
            ]
            found[keys.REFERENCE_LOC][rows] = torch.cat([part.loc for part in parts]).to(device)
            found[keys.REFERENCE_SCALE][rows] = torch.cat([part.scale for part in parts]).to(device)
        for key, value in found.items():
            wave[key] = value.view_as(wave[keys.CHUNK])


def greedy_exploration(run: Run, number: int) -> Episodes:
    """Exploration's rollouts without noise, of round ``number``."""
    settings = run.config.explore
    count = waves_per_scale(settings, len(run.config.tasks)) * settings.num_envs
    begin = count * settings.scale_factors.index(0.0)
    return recorded_episodes(run, number)[-1][begin : begin + count]


def solved_shares(episodes: Episodes) -> dict[int, float]:
    """By task id, the share of its episodes that reached the goal."""
    reached, tasks = episodes[keys.SUCCESS].flatten(1).any(-1).float(), episodes[keys.TASK_ID].squeeze(-1)
    return {task: reached[tasks == task].mean().item() for task in tasks.unique().tolist()}
