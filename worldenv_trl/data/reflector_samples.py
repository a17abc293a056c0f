"""Frames with their labels, for the reflector."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from worldenv_trl.keys import TASK_ID

__all__ = ["reflector_samples"]


def reflector_samples(episodes: TensorDictBase, *, once_solved: bool = False) -> TensorDict:
    """Videos and per-frame labels of ``episodes`` [R] (:func:`~worldenv_trl.data.episodes_from_rollouts`).

    Returns a TensorDict [R]: ``frames`` uint8 [R, T + 1, 3, H, W] (not a copy), ``label`` bool [R, T + 1], ``mask``
    bool [R, T + 1] (False past the end of an episode) and ``task_id`` [R, 1]. The label of frame t says whether the
    prefix o_0..o_t shows the goal reached.

    Args:
        episodes: with ``success``. Imagined frames take the labels of the physics that executed the same actions.

    Keyword Args:
        once_solved: keep the label True after the goal was first reached, even if it is undone later; by default the
            label follows the physics frame by frame.

    Raises:
        ValueError: for episodes without success labels.
    """
    if "success" not in episodes.keys():  # noqa: SIM118 - a TensorDict iterates over rows
        raise ValueError(
            "the episodes carry no success labels: imagined ones take those of the recorded rollouts whose actions "
            "they replay (episodes['success'] = recorded['success'])"
        )
    success = episodes["success"]
    if once_solved:
        success = success.long().cummax(1).values.bool()
    place = torch.arange(success.shape[1], device=success.device)
    return TensorDict(
        {
            "frames": episodes["frames"],
            "label": success,
            "mask": place <= episodes["length"],
            TASK_ID: episodes[TASK_ID],
        },
        batch_size=episodes.batch_size,
        device=episodes.device,
    )
