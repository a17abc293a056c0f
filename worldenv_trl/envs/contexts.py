"""Contexts (g, o_1, s_1): what an imagined rollout starts from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from worldenv_trl.keys import (
    CONTEXT_ID,
    INSTRUCTION,
    KINEMATIC_DIM,
    KINEMATIC_STATE,
    STATE,
    STATE_DIM,
    TASK_ID,
    image_key,
)
from worldenv_trl.kinematics import ForwardKinematics

__all__ = ["ContextOrder", "check_contexts", "context_keys"]


def context_keys(cameras: Sequence[str]) -> list[str | tuple[str, str]]:
    """The tensors of a context, for a world model that paints ``cameras``."""
    return [*(image_key(camera) for camera in cameras), STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID]


def check_contexts(
    contexts: TensorDictBase, kinematics: ForwardKinematics, cameras: Sequence[str], image_size: int
) -> None:
    """Raises ``ValueError`` unless ``contexts`` is a TensorDict [K] of complete contexts recorded with this robot."""
    if contexts.ndim != 1 or len(contexts) == 0:
        raise ValueError(
            f"contexts must be a TensorDict [K] of at least one initial state, got batch size {list(contexts.shape)}; "
            "collect them with TabletopEnv(...).reset()"
        )
    missing = [key for key in (*context_keys(cameras), INSTRUCTION) if contexts.get(key, None) is None]
    if missing:
        raise ValueError(
            f"contexts lack the entries {missing}; take them from TabletopEnv(..., cameras={tuple(cameras)}).reset()"
        )
    count = len(contexts)
    for camera in cameras:
        image = contexts[image_key(camera)]
        if image.dtype != torch.uint8 or tuple(image.shape) != (count, 3, image_size, image_size):
            raise ValueError(
                f"the contexts' {image_key(camera)} must be uint8 [K, 3, {image_size}, {image_size}], as the world "
                f"model paints them, got {image.dtype} {tuple(image.shape)}"
            )
    for key, width in ((STATE, STATE_DIM), (KINEMATIC_STATE, KINEMATIC_DIM), (TASK_ID, 1), (CONTEXT_ID, 1)):
        if tuple(contexts[key].shape) != (count, width):
            raise ValueError(f"the contexts' {key} must be {(count, width)}, got {tuple(contexts[key].shape)}")
    _check_state(contexts, kinematics)


class ContextOrder:
    """Which context each group starts from: shuffled pass after shuffled pass, the tasks in turn.

    Args:
        contexts: TensorDict [K] with their task ids.
    """

    def __init__(self, contexts: TensorDictBase) -> None:
        self._tasks = contexts[TASK_ID].flatten().tolist()
        self.seed(0)

    def seed(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)
        self._queue: list[int] = []

    def state_dict(self) -> dict[str, Any]:
        """Where the draws are."""
        return {"generator": self._generator.get_state(), "queue": list(self._queue)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Draws on from there, of the same contexts."""
        self._generator.set_state(state_dict["generator"])
        self._queue = list(state_dict["queue"])

    def draw(self, count: int) -> list[int]:
        """Places in the contexts [K] of the next ``count`` groups: no context twice in a draw if it can be."""
        drawn: list[int] = []
        while len(drawn) < count:
            if not self._queue:
                order = self._order()
                self._queue = [i for i in order if i not in drawn] + [i for i in order if i in drawn]
            drawn.append(self._queue.pop(0))
        return drawn

    def _order(self) -> list[int]:
        """All contexts, shuffled within their task, the tasks taking turns."""
        shuffled = torch.randperm(len(self._tasks), generator=self._generator).tolist()
        turn: dict[int, int] = {}
        turns = []
        for index in shuffled:
            turns.append(turn.get(self._tasks[index], 0))
            turn[self._tasks[index]] = turns[-1] + 1
        return [index for _, index in sorted(zip(turns, shuffled, strict=True), key=lambda pair: pair[0])]


def _check_state(contexts: TensorDictBase, kinematics: ForwardKinematics) -> None:
    """The proprioception and the joints must tell the same story: both come from the same robot, at rest."""
    apart = (kinematics.pose(contexts[KINEMATIC_STATE])[:, :3] - contexts[STATE][:, :3]).norm(dim=-1)
    worst = int(apart.argmax())
    if not float(apart[worst]) < 0.05:
        raise ValueError(
            f"context {int(contexts[CONTEXT_ID][worst])}: its state is {float(apart[worst]):.3f} m away from the "
            "forward kinematics of its joints; the contexts were recorded with another robot"
        )
