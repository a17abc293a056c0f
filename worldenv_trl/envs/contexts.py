"""Contexts (g, o_1, s_1): what an imagined rollout starts from."""

from __future__ import annotations

from collections.abc import Sequence

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

__all__ = ["check_contexts", "context_keys"]


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


def _check_state(contexts: TensorDictBase, kinematics: ForwardKinematics) -> None:
    """The proprioception and the joints must tell the same story: both come from the same robot, at rest."""
    apart = (kinematics.pose(contexts[KINEMATIC_STATE])[:, :3] - contexts[STATE][:, :3]).norm(dim=-1)
    worst = int(apart.argmax())
    if not float(apart[worst]) < 0.05:
        raise ValueError(
            f"context {int(contexts[CONTEXT_ID][worst])}: its state is {float(apart[worst]):.3f} m away from the "
            "forward kinematics of its joints; the contexts were recorded with another robot"
        )
