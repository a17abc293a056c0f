"""Behaviour-cloning samples: every executed step of an episode with the chunk of actions that follows."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from worldenv_trl.keys import ACTION_IS_PAD, CHUNK, CHUNK_LENGTH, IMAGE, STATE, TASK_ID

__all__ = ["policy_samples"]


def policy_samples(episodes: TensorDictBase, chunk_length: int = CHUNK_LENGTH) -> TensorDict:
    """One sample for each executed step of ``episodes`` [R] (:func:`~worldenv_trl.data.episodes_from_rollouts`).

    Returns a TensorDict [N], episode after episode: ``("observation", "image")`` uint8 [N, 3, H, W],
    ``("observation", "state")`` [N, 7], ``task_id`` [N, 1], ``("vla_action", "chunk")`` [N, C, 7] with the actions from
    this step on, and ``action_is_pad`` bool [N, C], True past the end of the episode, where the last action repeats.

    Raises:
        ValueError: for a chunk shorter than one step, or episodes in which nothing was executed.
    """
    if chunk_length < 1:
        raise ValueError(f"chunk_length must be at least 1, got {chunk_length}")
    length = episodes["length"]  # [R, 1]
    steps = torch.arange(episodes["actions"].shape[1], device=length.device)
    episode, step = (steps < length).nonzero(as_tuple=True)
    if not len(episode):
        raise ValueError(f"the {len(episodes)} episodes hold no executed step to learn from")
    wanted = step.unsqueeze(-1) + torch.arange(chunk_length, device=step.device)  # [N, C]
    end = length[episode]
    chunk = episodes["actions"][episode.unsqueeze(-1), torch.minimum(wanted, end - 1)]
    return TensorDict(
        {
            IMAGE: episodes["frames"][episode, step],
            STATE: episodes["states"][episode, step],
            TASK_ID: episodes[TASK_ID][episode],
            CHUNK: chunk,
            ACTION_IS_PAD: wanted >= end,
        },
        batch_size=[len(episode)],
        device=episodes.device,
    )
