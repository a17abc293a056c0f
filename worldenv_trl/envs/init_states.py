"""Which initial state a row starts from, and the number that names it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from worldenv_trl.scenes.tasks import SPLITS, Task

MODES = ("random", "cycle", "fixed")
UNKNOWN_CONTEXT = -1  # a state given by the caller without a number
_PER_TASK, _PER_SPLIT = 100_000, 50_000


def context_id(task_id: int, split: str, index: int) -> int:
    """The number of initial state ``index`` of a task's split; distinct over all tasks and both splits."""
    return task_id * _PER_TASK + SPLITS.index(split) * _PER_SPLIT + index


class InitStates:
    """The initial states of one task, in the order in which episodes draw them.

    Args:
        task: the task.
        split: ``train`` or ``test``.
        mode: ``random`` (shuffled pass after shuffled pass over the states), ``cycle`` (in order, from
            ``init_state_id`` on) or ``fixed`` (``init_state_id`` always).
        count: how many states of the split take part.
        init_state_id: see ``mode``.
        states: ``[K, S]`` states to use instead of the split's.
        context_ids: ``[K]`` their numbers; unknown ones are -1.

    Raises:
        ValueError: for an unknown mode, an index out of range, or numbers that do not match the states.
    """

    def __init__(
        self,
        task: Task,
        *,
        split: str = "train",
        mode: str = "random",
        count: int = 50,
        init_state_id: int = 0,
        states: np.ndarray | None = None,
        context_ids: Sequence[int] | None = None,
    ) -> None:
        if mode not in MODES:
            raise ValueError(f"init_state_mode must be 'random', 'cycle' or 'fixed', got {mode!r}")
        if states is None:
            if context_ids is not None:
                raise ValueError("context_ids names given init_states: pass both or neither")
            states = task.init_states(split, max(count, init_state_id + 1) if mode == "fixed" else count)
            context_ids = [context_id(task.task_id, split, index) for index in range(len(states))]
        states = np.atleast_2d(np.asarray(states, np.float64))
        context_ids = [UNKNOWN_CONTEXT] * len(states) if context_ids is None else [int(i) for i in context_ids]
        if len(states) == 0 or len(context_ids) != len(states):
            raise ValueError(
                f"got {len(states)} init_states and {len(context_ids)} context_ids: both must be as long, at least 1"
            )
        if not 0 <= init_state_id < len(states):
            raise ValueError(f"init_state_id must be in [0, {len(states)}), got {init_state_id}")
        self.task, self.mode, self.states, self.context_ids = task, mode, states, context_ids
        self.init_state_id = init_state_id
        self.seed(0)

    def seed(self, seed: int) -> None:
        self._seed, self._orders = seed, {}

    def draw(self, number: int) -> tuple[int, np.ndarray]:
        """Context id and state ``[S]`` of the task's ``number``-th episode: a function of seed and number only."""
        count = len(self.states)
        if self.mode == "fixed":
            index = self.init_state_id
        elif self.mode == "cycle":
            index = (self.init_state_id + number) % count
        else:
            epoch, place = divmod(number, count)
            if epoch not in self._orders:
                self._orders[epoch] = np.random.default_rng([self._seed, self.task.task_id, epoch]).permutation(count)
            index = self._orders[epoch][place]
        return self.context_ids[index], self.states[index]

    def find(self, number: int) -> np.ndarray:
        """The state ``[S]`` named by a context id, in this env's states or in either split of the task.

        Raises:
            ValueError: if the number names no initial state of this task.
        """
        if number != UNKNOWN_CONTEXT and number in self.context_ids:
            return self.states[self.context_ids.index(number)]
        task, rest = divmod(number, _PER_TASK)
        if task != self.task.task_id:
            raise ValueError(
                f"context_id {number} names no initial state of {self.task.name} "
                f"(its own are {self.task.task_id * _PER_TASK} and up): pass sim_state, or reset an env of that task"
            )
        split, index = divmod(rest, _PER_SPLIT)
        return self.task.init_states(SPLITS[split], index + 1)[index]
