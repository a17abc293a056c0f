"""Successes of exploration played again, the hand moved aside: how far beside a path still succeeds.

Noise of the actions makes a path jagged, and what LOOP makes of a policy is smooth: a judge that has seen only the
first sort takes smoothness for success, wherever the hand goes. What a smooth path beside the right one, above or below
it comes to is seen here, and labelled by the physics.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import MultiStepActorWrapper

from physics import chunk_player, exploring_actor, reached_goal, starting_at, step_env
from resumable import Outside, Resumable
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import context_id

if TYPE_CHECKING:
    from config import Explore
    from resumable_recording import ResumableRecording
    from run import Run
    from worldenv_trl.policies import Policy

MOVED_IN = 12  # steps: from the start, before a hand has come down
_LATE = 0.5  # share that begins to be moved on the way: what is taken hold of rightly may be carried elsewhere


def replays_per_task(settings: Explore) -> int:
    """Of exploration's episodes of a task, those that are played again."""
    return round(settings.replay_share * settings.episodes_per_task)


class Successes:
    """The rollouts of at most ``max_steps`` steps that reached the goal: where they began, what was done, and when they
    had."""

    def __init__(self, max_steps: int) -> None:
        self._max_steps = max_steps
        self._parts: list[TensorDictBase] = []

    def note(self, rollouts: TensorDictBase) -> None:
        """Takes those of ``rollouts`` [n, T] that succeed."""
        mask = rollouts[keys.MASK]
        success = rollouts["next", keys.SUCCESS].squeeze(-1) & mask
        actions = rollouts[keys.ACTION] * mask.unsqueeze(-1)
        begun = rollouts.select(keys.CONTEXT_ID, keys.TASK_ID)[:, 0]
        parts = {name: begun[name].squeeze(-1) for name in (keys.CONTEXT_ID, keys.TASK_ID)}
        parts["actions"] = F.pad(actions, (0, 0, 0, self._max_steps - actions.shape[1]))
        parts["reached"] = success.long().argmax(-1)
        self._parts.append(TensorDict(parts, batch_size=[len(mask)])[success.any(-1)])

    def of_task(self, number: int) -> TensorDictBase:
        """``actions`` [n, T, 7], and ``context_id``, ``task_id`` and ``reached``, the step that does, int64 [n]."""
        every = TensorDict.cat(self._parts)
        return every[every[keys.TASK_ID] == number]

    def state_dict(self) -> dict[str, Any]:
        return TensorDict.cat(self._parts).to_dict() if self._parts else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._parts = [TensorDict.from_dict(state_dict, auto_batch_size=True)] if state_dict else []


def directions(count: int, drawn: torch.Generator) -> Tensor:
    """Unit vectors [n, 3], all directions alike."""
    return F.normalize(torch.randn(count, 3, generator=drawn), dim=-1)


def moved_aside(actions: Tensor, shifts: Tensor, begin: Tensor | None = None) -> Tensor:
    """Actions [n, T, 7] that take the hand to the same path moved by ``shifts`` [n, 3] (m), and along it, from the step
    ``begin`` int64 [n] on, or from the first; less far where an action would exceed [-1, 1]."""
    step = torch.arange(actions.shape[1])
    since = step - (torch.zeros(len(actions), 1) if begin is None else begin.unsqueeze(-1))  # [n, T]
    moving = (since >= 0) & (since < MOVED_IN)
    moved = actions.clone()
    moved[..., :3] += moving.unsqueeze(-1) * shifts.unsqueeze(1) / (MOVED_IN * keys.POSITION_STEP)
    return moved.clamp(-1, 1)


def play_again(run: Run, policy: Policy, successes: Successes, recorded: ResumableRecording, target: str) -> None:
    """Plays successes drawn of every task again, each moved by up to ``replay_shift_m``, records and logs them.

    The recording shows what was done as ``action``, and beside it what ``policy`` would have done. A task without a
    success has nothing to be played again: a warning says so.
    """
    config, settings = run.config, run.config.explore
    drawn = torch.Generator().manual_seed(run.seed(target, "replays"))
    waves: list[TensorDictBase] = []
    for number, name in enumerate(config.tasks):
        found = successes.of_task(number)
        waves += _drawn(found, settings, drawn)
        if not len(found):
            warnings.warn(
                f"no explored rollout of {name} reached the goal: none is played again, {replays_per_task(settings)} "
                "episodes fewer are explored",
                stacklevel=2,
            )
    player = chunk_player(exploring_actor(config, policy, 1e-6), config.chunk_length)
    reached: list[float] = []
    left = Resumable(run, "replays", len(waves), recording=Outside(recorded), reached=reached)
    for index in left.bar(f"{target} moved aside", "wave"):
        wave = waves[index]
        number = int(wave[keys.TASK_ID][0])
        name, starts = config.tasks[number], wave[keys.CONTEXT_ID] - context_id(number, "train", 0)
        env = step_env(
            config,
            "train",
            len(wave),
            [name],
            terminate_on_success=False,
            with_sim_state=True,
            **starting_at(config, "train", name, starts.tolist()),
        )
        collector = GroupCollector(
            env,
            _Replay(player, wave["actions"]),
            groups_per_batch=len(wave),
            total_groups=len(wave),
            group_size=1,
            max_decisions=config.max_steps,
        )
        rollouts = next(iter(collector))[:, 0]
        recorded.writer.write(rollouts)
        reached += reached_goal(rollouts).tolist()
        collector.shutdown()
    if reached:
        run.folder.log(
            target, replay_shift_m=settings.replay_shift_m, episodes=len(reached), success=sum(reached) / len(reached)
        )


def _drawn(found: TensorDictBase, settings: Explore, drawn: torch.Generator) -> Iterator[TensorDictBase]:
    """Waves of a task's successes to be played again, with the actions that move them."""
    if not len(found):
        return
    count = replays_per_task(settings)
    chosen = found[torch.randint(len(found), (count,), generator=drawn)].clone()
    far = settings.replay_shift_m * torch.rand(count, 1, generator=drawn)
    late = torch.rand(count, generator=drawn) < _LATE
    begin = late * (torch.rand(count, generator=drawn) * chosen["reached"]).long()
    chosen["actions"] = moved_aside(chosen["actions"], far * directions(count, drawn), begin)
    waves = -(-count // settings.num_envs)
    yield from chosen.split(-(-count // waves))


class _Replay(TensorDictModuleBase):
    """What ``player`` says, and the actions [n, T, 7] instead of its own; for one rollout."""

    def __init__(self, player: MultiStepActorWrapper, actions: Tensor) -> None:
        super().__init__()
        self.player, self.actions, self._step = player, actions, 0
        self.in_keys, self.out_keys = player.in_keys, player.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = self.player(tensordict)
        tensordict[keys.ACTION] = self.actions[:, self._step]
        self._step += 1
        return tensordict
