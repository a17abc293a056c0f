"""Where recorded episodes have been: imagined rollouts may go on from there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor

from worldenv_trl.keys import CONTEXT_ID, KINEMATIC_STATE, KINEMATIC_STATES, STATE, TASK_ID, frames_key, image_key

if TYPE_CHECKING:
    from worldenv_trl.data import Episodes

__all__ = ["BranchPoints"]


class BranchPoints:
    """States of recorded episodes at the ends of chunks, from which imagined rollouts go on (the branched rollouts of
    MBPO, Janner et al. 2019, 1906.08253).

    A world model drifts: what a rollout shows after a few chunks is not what the physics would, and a policy that
    learns there learns for frames it will never see. A rollout that begins in the middle of an episode sees real frames
    where its first decision is taken, and its judge knows the real beginning.

    A point lies half a chunk or more before its episode reaches the goal or ends, and never at its beginning: there are
    the contexts. Within a task every episode is drawn as often as any other, and then one of its points.

    Args:
        episodes: of the physics, with the frames of the world model's cameras and ``success``; on the CPU.
        chunk_length: steps from one point of an episode to the next.

    Keyword Args:
        share: of the groups that begin at a point, in [0, 1]; the others begin at a context. May be assigned.
        latest: the last step at which a rollout may begin.

    Raises:
        ValueError: naming the argument out of bounds, or for episodes without labels.

    Examples:
        >>> from worldenv_trl.data import episodes_from_rollouts
        >>> from worldenv_trl.envs import TabletopEnv
        >>> env = TabletopEnv("starter/open_the_top_drawer", 2, seed=0, max_steps=24)
        >>> points = BranchPoints(episodes_from_rollouts(env.rollout(24)), 8, share=1.0)
        >>> len(points), points.steps.tolist()
        (4, [8, 16, 8, 16])
        >>> points.past(torch.tensor([1, 3]))["frames", "image"].shape
        torch.Size([2, 17, 3, 64, 64])
    """

    def __init__(self, episodes: Episodes, chunk_length: int, *, share: float, latest: int = 40) -> None:
        if chunk_length < 1 or latest < chunk_length or latest != int(latest):
            raise ValueError(
                "chunk_length must be at least 1 and latest a whole number not below it, got "
                f"{chunk_length} and {latest}"
            )
        if "success" not in episodes:
            raise ValueError("the episodes carry no success labels: branch points lie before the goal is reached")
        self.episodes, self.chunk_length, self.latest = episodes, int(chunk_length), int(latest)
        self.share = share
        length = episodes["length"].squeeze(-1)
        done = episodes["success"].long().cummax(1).values
        reached = torch.where(done[:, -1] > 0, done.shape[1] - done.sum(1), length)
        last = (torch.minimum(reached, length) - chunk_length // 2).clamp(min=0, max=latest)
        self._count = last // chunk_length  # points of each episode
        self._first = self._count.cumsum(0) - self._count
        task = episodes[TASK_ID].squeeze(-1)
        some = self._count > 0
        self._pools = {int(each): (some & (task == each)).nonzero().squeeze(-1) for each in task[some].unique()}
        self.rows = torch.arange(len(task)).repeat_interleave(self._count)  # episode of each point
        self.steps = chunk_length * (1 + torch.arange(len(self.rows)) - self._first[self.rows])

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def share(self) -> float:
        """Of the groups that begin at a point."""
        return self._share

    @share.setter
    def share(self, share: float) -> None:
        if not 0 <= share <= 1:
            raise ValueError(f"share must lie between 0 and 1, got {share}")
        self._share = float(share)

    def draw(self, task: int, generator: torch.Generator) -> int | None:
        """Number of a point of an episode of ``task``; None where a group is to begin at a context, as it is where
        there is no point."""
        pool = self._pools.get(task)
        chosen = bool(torch.rand((), generator=generator) < self.share)
        if not chosen or pool is None:
            return None
        episode = pool[torch.randint(len(pool), (), generator=generator)]
        return int(self._first[episode] + torch.randint(int(self._count[episode]), (), generator=generator))

    def starts(self, points: Tensor) -> tuple[TensorDict, list[str]]:
        """What is seen and known at ``points`` [n], as a context holds it, and their instructions."""
        row, step, episodes = self.rows[points], self.steps[points], self.episodes
        out = TensorDict(
            {
                STATE: episodes["states"][row, step],
                KINEMATIC_STATE: episodes["kinematic_states"][row, step],
                TASK_ID: episodes[TASK_ID][row],
                CONTEXT_ID: episodes[CONTEXT_ID][row],
            },
            batch_size=[len(points)],
        )
        for camera in episodes.cameras:
            out[image_key(camera)] = episodes.frames(camera, row, step)
        return out, [episodes.instructions[each] for each in row.tolist()]

    def frames(self, camera: str, points: Tensor, numbers: Tensor) -> Tensor:
        """Frames ``numbers`` [K] of the episodes of ``points`` [n]: uint8 [n, K, 3, H, W]."""
        return self.episodes.frames(camera, self.rows[points].unsqueeze(-1), numbers)

    def kinematic_states(self, points: Tensor, count: int) -> Tensor:
        """The first ``count`` kinematic states of the episodes of ``points`` [n]: [n, count, 20]."""
        return self.episodes["kinematic_states"][self.rows[points], :count]

    def past(self, points: Tensor) -> TensorDict:
        """All that was shown up to ``points`` [n], at least one, which are at the same step t.

        Returns:
            TensorDict [n]: ``("frames", entry)`` uint8 [n, t + 1, 3, H, W] by camera, ``kinematic_states``
            [n, t + 1, 20].

        Raises:
            ValueError: for points at several steps.
        """
        if len(self.steps[points].unique()) > 1:
            raise ValueError(f"points must be at the same step, got {self.steps[points].unique().tolist()}")
        numbers = torch.arange(int(self.steps[points[0]]) + 1)
        out = TensorDict({KINEMATIC_STATES: self.kinematic_states(points, len(numbers))}, batch_size=[len(points)])
        for camera in self.episodes.cameras:
            out[frames_key(camera)] = self.frames(camera, points, numbers)
        return out
