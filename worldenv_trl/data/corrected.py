"""Action chunks to imitate, of explored episodes: their own, led to where another from the same start took hold."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from worldenv_trl.data.episodes import Episodes
from worldenv_trl.data.samples import executed_steps, gripper_changes, samples_at
from worldenv_trl.keys import (
    ACTION_IS_PAD,
    APPROACH,
    CHUNK,
    CHUNK_LENGTH,
    CONTEXT_ID,
    NUM_STEPS,
    POSITION_STEP,
    WAYPOINT,
)

__all__ = ["corrected_samples", "until_reached"]

_PLACES = 2  # where a thing is taken hold of, and where it is let go
_SLACK = 1  # steps after the gripper was told otherwise that are imitated, too


def corrected_samples(
    episodes: Episodes, noise: Tensor, chunk_length: int = CHUNK_LENGTH, *, reach: float = 0.08
) -> TensorDict:
    """What would have been right at the steps of explored episodes, as far as others from the same initial state tell.

    Episodes that reach the goal tell where a thing is taken hold of there, and where it is put: the hand's position
    when the gripper is first told otherwise, and the second time. Of each initial state (``context_id``) those tell
    that were sampled with the least noise, together their mean. Every episode from there, failures too, is then a
    demonstration of how to get to that place: its actions up to its own change of the gripper, and added to them what
    is missing to the place, over the table, as the ``approach`` of :func:`~worldenv_trl.data.policy_samples` shares it
    out. So neither where a failure's hand went nor the noise of its actions is imitated. (Of demonstrations, MimicGen,
    arXiv:2310.17596, adapts segments to where a thing is that the simulator knows; here it is another rollout that
    tells.)

    Args:
        episodes: [R], with ``success``.
        noise: [R], how noisy each was sampled.
        chunk_length: steps of a chunk.
        reach: how far (m) an episode may have been from the place; of others too little is known.

    Returns:
        A TensorDict [N] as of ``policy_samples`` without images; ``action_is_pad`` is True from two steps after the
        gripper's change on. N is 0 where no success tells of a place.

    Raises:
        ValueError: for a noise of another length or with NaN, a chunk shorter than one step or a reach that is not
            positive.
        KeyError: for episodes without success.
    """
    if noise.shape != (len(episodes),):
        raise ValueError(f"noise must be [{len(episodes)}], one number for each episode, got {list(noise.shape)}")
    if noise.isnan().any():
        raise ValueError(f"noise must be numbers, {int(noise.isnan().sum())} of {len(noise)} are NaN")
    noise = noise.to(torch.get_default_dtype())
    if chunk_length < 1 or not reach > 0:
        raise ValueError(f"chunk_length must be at least 1 and reach positive, got {chunk_length} and {reach}")
    episodes = until_reached(episodes)
    rows = torch.arange(len(episodes))
    reached, changes = episodes["success"].any(1), gripper_changes(episodes)
    count = changes.cumsum(1)
    tells, before, found = reached & (count[:, -1] <= _PLACES), torch.zeros_like(rows), []
    for number in range(1, _PLACES + 1):
        has = count[:, -1] >= number
        at = torch.where(has, (count == number).int().argmax(1), episodes["length"].squeeze(-1) - 1)
        place = episodes["states"][rows, at, :3]
        right = _told(place, tells & has, noise, episodes[CONTEXT_ID].squeeze(-1))
        missing = right - place  # NaN where nothing tells
        found.append(_led(episodes, has & (missing.norm(dim=-1) < reach), before, at, missing, right, chunk_length))
        before = torch.where(has, at, before)
    return torch.cat(found)


def until_reached(episodes: Episodes) -> Episodes:
    """The same episodes [R], each no longer than three steps after the goal is first reached; numbers are a copy.

    Raises:
        KeyError: for episodes without ``success``.
    """
    out, reached = episodes[torch.arange(len(episodes))], episodes["success"]
    length = out["length"]
    end = torch.where(reached.any(1), reached.int().argmax(1) + 3, length.squeeze(-1))
    out.entries["length"] = torch.minimum(length, end.unsqueeze(-1))
    return out


def _told(place: Tensor, tells: Tensor, noise: Tensor, context: Tensor) -> Tensor:
    """[R, 3]: the mean of the places [R, 3] of a context's least noisy episodes that tell, NaN where none does."""
    _, group = context.unique(return_inverse=True)
    least = torch.full((len(context),), torch.inf, dtype=noise.dtype)
    least = least.scatter_reduce(0, group, torch.where(tells, noise, torch.inf), "amin")
    chosen = (tells & (noise == least[group])).to(place.dtype)
    total = torch.zeros(len(context), 3).index_add(0, group, place * chosen.unsqueeze(-1))
    return (total / torch.zeros(len(context)).index_add(0, group, chosen).unsqueeze(-1))[group]


def _led(
    episodes: Episodes, used: Tensor, before: Tensor, at: Tensor, missing: Tensor, right: Tensor, chunk_length: int
) -> TensorDict:
    """Samples of the steps from ``before`` up to ``at``, int64 [R] each, of the episodes ``used``, bool [R]."""
    episode, step = executed_steps(episodes)
    wanted = used[episode] & (step >= before[episode]) & (step < at[episode])
    episode, step = episode[wanted], step[wanted]
    out = samples_at(episodes, episode, step, chunk_length)
    added = missing[episode, None, :2] * out[APPROACH].unsqueeze(-1) / POSITION_STEP
    out[CHUNK][..., :2] = (out[CHUNK][..., :2] + added).clamp(-1, 1)
    steps = out[NUM_STEPS] + torch.arange(chunk_length)
    out[ACTION_IS_PAD] = out[ACTION_IS_PAD] | (steps > at[episode, None] + _SLACK)
    out[WAYPOINT] = right[episode]
    return out
