"""Which initial state a row starts from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import mujoco
import numpy as np
from torch import Tensor

from worldenv_trl.context_ids import UNKNOWN_CONTEXT, context_id, parts_of
from worldenv_trl.scenes import Task

__all__ = ["MODES", "InitStates"]

MODES = ("random", "cycle", "fixed")


class InitStates:
    """The initial states of one task, in the order in which episodes draw them.

    Args:
        task: the task.

    Keyword Args:
        task_id: the task's number in this run, which its states' context ids begin with.
        split: ``train`` or ``test``.
        mode: ``random`` (shuffled pass after shuffled pass over the states), ``cycle`` (in order, from
            ``init_state_id`` on) or ``fixed`` (``init_state_id`` always).
        count: how many states of the split take part.
        init_state_id: see ``mode``.
        states: ``[K, S]`` states to use instead of the split's.
        context_ids: ``[K]`` their numbers; unknown ones are -1.

    Raises:
        TypeError: for states or numbers that are none.
        ValueError: for an unknown mode, an index out of range, states of another task's length or that hold NaN or
            infinity, and numbers that do not match the states or name two of them.
    """

    def __init__(
        self,
        task: Task,
        *,
        task_id: int = 0,
        split: str = "train",
        mode: str = "random",
        count: int = 50,
        init_state_id: int = 0,
        states: np.ndarray | Tensor | None = None,
        context_ids: Sequence[int] | None = None,
    ) -> None:
        if mode not in MODES:
            raise ValueError(f"init_state_mode must be 'random', 'cycle' or 'fixed', got {mode!r}")
        if states is None:
            if context_ids is not None:
                raise ValueError("context_ids names given init_states: pass both or neither")
            self.states = task.init_states(split, max(count, init_state_id + 1) if mode == "fixed" else count)
            self.context_ids = [context_id(task_id, split, index) for index in range(len(self.states))]
        else:
            self.states = _given_states(task, states)
            unknown = [UNKNOWN_CONTEXT] * len(self.states)
            self.context_ids = unknown if context_ids is None else _numbers(context_ids, self.states)
        if not 0 <= init_state_id < len(self.states):
            raise ValueError(f"init_state_id must be in [0, {len(self.states)}), got {init_state_id}")
        self.task, self.mode = task, mode
        self.task_id, self.init_state_id = task_id, init_state_id
        # Of the order alone: a function of the task's name, not of its number in the run at hand.
        self._identity = int.from_bytes(hashlib.sha256(task.name.encode()).digest()[:8], "big")
        self.seed(0)

    def seed(self, seed: int) -> None:
        self._seed = seed
        self._orders: dict[int, np.ndarray] = {}  # of each pass over the states

    def draw(self, number: int) -> tuple[int, np.ndarray]:
        """Context id and state ``[S]`` of the task's ``number``-th episode; see :meth:`place`."""
        place = self.place(number)
        return self.context_ids[place], self.states[place]

    def at(self, places: Sequence[int]) -> tuple[list[int], np.ndarray]:
        """Context ids and states ``[n, S]`` at some places."""
        return [self.context_ids[place] for place in places], self.states[list(places)]

    def place(self, number: int) -> int:
        """Which of the states the task's ``number``-th episode starts from: a function of seed and number only."""
        count = len(self.states)
        if self.mode == "fixed":
            return self.init_state_id
        if self.mode == "cycle":
            return (self.init_state_id + number) % count
        epoch, place = divmod(number, count)
        if epoch not in self._orders:
            self._orders[epoch] = np.random.default_rng([self._seed, self._identity, epoch]).permutation(count)
        return int(self._orders[epoch][place])

    def find(self, number: int) -> np.ndarray:
        """The state ``[S]`` named by a context id, in this env's states or in either split of the task.

        Raises:
            ValueError: if the number names no initial state of this task.
        """
        if number != UNKNOWN_CONTEXT and number in self.context_ids:
            return self.states[self.context_ids.index(number)]
        task_id, split, index = parts_of(number)
        if task_id != self.task_id:
            raise ValueError(
                f"context_id {number} names no initial state of {self.task.name} (its own are "
                f"{context_id(self.task_id, 'train', 0)} and up): pass sim_state, or reset an env of that task"
            )
        return self.task.init_states(split, index + 1)[index]


def _given_states(task: Task, states: object) -> np.ndarray:
    """``states`` as float64 ``[K, S]``, if they are states of the task."""
    try:
        array = np.asarray(states)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"init_states cannot be read as an array ({error}): pass float64 [K, S]") from None
    if array.dtype.kind not in "fiu":
        raise TypeError(f"init_states must be numbers [K, S], got {array.dtype} {list(array.shape)}")
    size = mujoco.mj_stateSize(task.build(), mujoco.mjtState.mjSTATE_INTEGRATION)
    array = array[None] if array.ndim == 1 else array
    if array.ndim != 2 or array.shape[1] != size or not len(array):
        raise ValueError(
            f"init_states must be [K, {size}] for {task.name}, at least one, got {list(array.shape)}: take them from "
            "its init_states(...), or from the sim_state of an env of this task alone"
        )
    broken = np.flatnonzero(~np.isfinite(array).all(-1))
    if len(broken):
        raise ValueError(f"init_states for {task.name} hold NaN or infinity in rows {broken.tolist()}")
    return array.astype(np.float64)


def _numbers(context_ids: Sequence[int], states: np.ndarray) -> list[int]:
    """``context_ids`` as a list, if they can be the numbers of ``states [K, S]``."""
    array = np.asarray(context_ids)
    if array.dtype.kind not in "iu" and array.size:
        raise TypeError(f"context_ids must be whole numbers [{len(states)}], got {context_ids!r}")
    numbers = array.reshape(-1).tolist()
    if len(numbers) != len(states):
        raise ValueError(f"got {len(states)} init_states and {len(numbers)} context_ids: both must be as long")
    first: dict[int, int] = {}
    for row, number in enumerate(numbers):
        if number < UNKNOWN_CONTEXT:
            raise ValueError(f"context_ids must be at least 0, or -1 for a state without a number, got {number}")
        if number != UNKNOWN_CONTEXT and (states[first.setdefault(number, row)] != states[row]).any():
            raise ValueError(f"context_id {number} names two different init_states, rows {first[number]} and {row}")
    return numbers
