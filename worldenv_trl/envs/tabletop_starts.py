"""Where the rows of a :class:`~worldenv_trl.envs.TabletopEnv` begin: drawn, or given by the caller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from worldenv_trl.context_ids import UNKNOWN_CONTEXT
from worldenv_trl.envs.init_states import InitStates
from worldenv_trl.envs.starts import GivenStarts
from worldenv_trl.keys import CONTEXT_ID, NUM_STEPS, SIM_STATE, TASK_ID
from worldenv_trl.scenes import SceneBatch, Task

__all__ = ["Block", "TabletopStarts"]


@dataclass
class Block:
    """The rows of one task."""

    scene: SceneBatch
    starts: InitStates
    rows: np.ndarray  # [m] rows of the env
    groups: np.ndarray  # [m] which of the task's groups a row belongs to
    num_groups: int


class TabletopStarts(GivenStarts):
    """Of an env whose rows are those of some tasks, each with initial states of its own."""

    tasks: tuple[Task, ...]
    _blocks: list[Block]
    _seed: int
    _episode: np.ndarray  # [n] numbers of the rows' episodes
    _steps: np.ndarray  # [n, 1]
    _limit: np.ndarray  # [n, 1]
    _sim_size: int

    def order_state(self) -> dict[str, Any]:
        """What decides which initial states the next reset of all rows begins with; take it between waves."""
        return {"seed": self._seed, "episode": torch.tensor(self._episode)}

    def load_order_state(self, state: dict[str, Any]) -> None:
        """Lets the next reset of all rows begin as it would have where :meth:`order_state` gave ``state``."""
        self._seed, self._episode = state["seed"], state["episode"].numpy().copy()
        for block in self._blocks:
            block.starts.seed(self._seed)

    def draw_starts(self) -> TensorDict:
        """Draws what the next reset of all rows would begin with, and counts as that reset; nothing is simulated.

        Returns:
            TensorDict ``[num_envs]``: ``place`` int64, which of its task's initial states a row starts from, and
            ``episode`` int64, its number. For :meth:`begin_with`, also of groups from a multiple of
            :attr:`groups_per_deal` on.
        """
        self._episode[:] = self._episode.max(initial=-1) + 1  # rows reset together stay in step: groups share states
        place = np.zeros(len(self._episode), np.int64)
        for block in self._blocks:
            place[block.rows] = self._places(block)
        return TensorDict(
            {"place": torch.from_numpy(place), "episode": torch.from_numpy(self._episode.copy())}, self.batch_size
        )

    @property
    def groups_per_deal(self) -> int:
        """Groups are dealt to the tasks in turn: one to each is a deal."""
        return len(self.tasks)

    def _drawn(self, block: Block, local: np.ndarray) -> tuple[list[int], np.ndarray]:
        """The next initial states of some of a task's rows."""
        return block.starts.at(self._places(block, local))

    def _places(self, block: Block, local: np.ndarray | slice = slice(None)) -> list[int]:
        order = self._episode[block.rows[local]] * block.num_groups + block.groups[local]
        return [block.starts.place(number) for number in order.tolist()]

    def _given(self, tensordict: TensorDictBase | None, block: Block, rows: np.ndarray) -> tuple[list[int], np.ndarray]:
        """The states of a task's ``rows`` that the caller put into the reset's tensordict."""
        given = TensorDict() if tensordict is None else tensordict
        sim_state, numbers, task = (given.get(key, None) for key in (SIM_STATE, CONTEXT_ID, TASK_ID))
        if sim_state is None and numbers is None:
            raise ValueError(f"reset(set_state=True) needs {SIM_STATE!r} or {CONTEXT_ID!r} in its tensordict")
        if task is not None and (task.reshape(-1).numpy()[rows] != block.starts.task_id).any():
            raise ValueError(
                f"reset(set_state=True): rows {rows.tolist()} run {block.scene.task.name}, {TASK_ID} says otherwise"
            )
        numbers = [UNKNOWN_CONTEXT] * len(rows) if numbers is None else numbers.reshape(-1).numpy()[rows].tolist()
        if sim_state is None:
            return numbers, np.stack([block.starts.find(number) for number in numbers])
        length = block.scene.batch.nstate
        if sim_state.shape[:-1] != self.batch_size or sim_state.shape[-1] < length:
            raise ValueError(
                f"{SIM_STATE} must be [{len(self._episode)}, {self._sim_size}] for {block.scene.task.name}, "
                f"got {list(sim_state.shape)}"
            )
        steps = given.get(NUM_STEPS, None)
        if steps is not None:
            steps = steps.reshape(-1, 1).numpy()[rows]
            if (steps >= self._limit[rows]).any():
                raise ValueError(
                    f"a state at {NUM_STEPS}={int(steps.max())} is past max_steps={int(self._limit[rows].min())}"
                )
            self._steps[rows] = steps
        return numbers, sim_state.numpy().astype(np.float64, copy=False)[rows, :length]
