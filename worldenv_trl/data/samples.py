"""Training samples of the policy."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from worldenv_trl import keys

__all__ = ["policy_samples"]


def policy_samples(episodes: TensorDictBase, chunk_length: int = keys.CHUNK_LENGTH) -> TensorDict:
    """One sample for every executed step: what was seen, and the chunk of actions that followed.

    Args:
        episodes: ``[R]``, see :func:`episodes_from_rollouts`.
        chunk_length: ``C``.

    Returns:
        TensorDict ``[N]`` with image, state, task id, ``("vla_action", "chunk")`` [N, C, 7] and ``action_is_pad`` bool
        [N, C]: past the end of an episode the last action is repeated and marked.

    Raises:
        ValueError: if there are no episodes, or the chunk is empty.
    """
    if chunk_length < 1:
        raise ValueError(f"chunk_length must be at least 1, got {chunk_length}")
    if not len(episodes):
        raise ValueError("there are no episodes to make samples of")
    length = episodes["length"]  # [R, 1]
    row, step = (torch.arange(episodes["actions"].shape[1]) < length).nonzero(as_tuple=True)
    wanted = step.unsqueeze(-1) + torch.arange(chunk_length)  # [N, C]
    last = length[row] - 1
    return TensorDict(
        {
            "observation": {"image": episodes["frames"][row, step], "state": episodes["states"][row, step]},
            keys.TASK_ID: episodes[keys.TASK_ID][row],
            "vla_action": {"chunk": episodes["actions"][row.unsqueeze(-1), torch.minimum(wanted, last)]},
            keys.ACTION_IS_PAD: wanted > last,
        },
        batch_size=[len(row)],
    )
