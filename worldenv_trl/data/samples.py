"""Action chunks to imitate, from episodes."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict import TensorDict

from worldenv_trl.data.episodes import Episodes
from worldenv_trl.keys import (
    ACTION_IS_PAD,
    APPROACH,
    CHUNK,
    CHUNK_LENGTH,
    INSTRUCTION,
    NUM_STEPS,
    STATE,
    WAYPOINT,
    image_key,
)
from worldenv_trl.row_texts import row_texts

__all__ = ["executed_steps", "gripper_changes", "policy_samples", "samples_at", "with_images"]

_STEP = 0.05  # of an action, so that a step in which the hand does not move over the table counts as one


def policy_samples(episodes: Episodes, chunk_length: int = CHUNK_LENGTH, *, images: bool = True) -> TensorDict:
    """One sample for each executed step of ``episodes``.

    Returns a TensorDict [N], episode after episode: ``("observation", ...)`` uint8 [N, 3, H, W] of every camera,
    ``("observation", "state")`` [N, 7], ``language_instruction``, ``num_steps`` [N, 1], those executed before this one,
    ``("vla_action", "chunk")`` [N, C, 7] with the actions from this step on, ``action_is_pad`` bool [N, C], True past
    the end of the episode, where the last action repeats, and ``("vla_action", "waypoint")`` [N, 3], the hand's
    position (m) when the gripper is next told to close or to open, or at the end: where things are taken hold of and
    let go (keyframes of C2F-ARM, arXiv:2106.12534). ``("vla_action", "approach")`` [N, C] is the share of the way over
    the table to there, from this step on, that each action goes; 0 where the episode ends without another change,
    unless something is held: then its end is where that is put.

    Without ``images`` neither these nor the instruction are there, but ``episode`` int64 [N], which of the episodes
    each is of: :func:`with_images` adds them to those of a batch, where all together are too many.

    Raises:
        ValueError: for a chunk shorter than one step, or episodes in which nothing was executed.
    """
    if chunk_length < 1:
        raise ValueError(f"chunk_length must be at least 1, got {chunk_length}")
    episode, step = executed_steps(episodes)
    if not len(episode):
        raise ValueError(f"the {len(episodes)} episodes hold no executed step to learn from")
    samples = samples_at(episodes, episode, step, chunk_length)
    return with_images(episodes, samples) if images else samples


def executed_steps(episodes: Episodes) -> tuple[torch.Tensor, torch.Tensor]:
    """Episode and step, int64 [N] each, of every executed step, episode after episode."""
    length = episodes["length"]  # [R, 1]
    steps = torch.arange(episodes["actions"].shape[1], device=length.device)
    episode, step = (steps < length).nonzero(as_tuple=True)
    return episode, step


def with_images(episodes: Episodes, samples: TensorDict) -> TensorDict:
    """A shallow copy of samples [N] without images, of these episodes, with the images uint8 [N, 3, H, W] of every
    camera and the instruction instead of ``episode``; see :func:`policy_samples`.

    Raises:
        KeyError: for samples that do not say which episode they are of.
        ValueError: for no samples.
    """
    out = samples.copy()
    episode, step = out.pop("episode"), samples[NUM_STEPS].squeeze(-1)
    if not len(episode):
        raise ValueError("there are no samples, so no images of them")
    for camera in episodes.cameras:
        out[image_key(camera)] = episodes.frames(camera, episode, step)
    return out.set(INSTRUCTION, row_texts([episodes.instructions[row] for row in episode.tolist()]))


def samples_at(episodes: Episodes, episode: torch.Tensor, step: torch.Tensor, chunk_length: int) -> TensorDict:
    """What :func:`policy_samples` tells without images of the executed steps ``step`` of the episodes ``episode``,
    int64 [N] each."""
    length = episodes["length"]
    wanted = step.unsqueeze(-1) + torch.arange(chunk_length, device=step.device)  # [N, C]
    end = length[episode]
    chunk = episodes["actions"][episode.unsqueeze(-1), torch.minimum(wanted, end - 1)]
    out = TensorDict({STATE: episodes["states"][episode, step], NUM_STEPS: step[:, None]}, batch_size=[len(episode)])
    out[CHUNK], out[ACTION_IS_PAD], out["episode"] = chunk, wanted >= end, episode
    change = _next_change(episodes)[episode, step]
    out[WAYPOINT] = episodes["states"][episode, change, :3]
    goes = (change.unsqueeze(-1) < end) | _holding(episodes)[episode, step].unsqueeze(-1)
    ahead = (wanted < change.unsqueeze(-1)) & goes
    way = _way(episodes)
    at = way[episode.unsqueeze(-1), torch.cat([wanted, wanted[:, -1:] + 1], 1).minimum(end)]  # [N, C + 1]
    out[APPROACH] = ahead * at.diff(dim=1) / (way[episode, change] - way[episode, step]).unsqueeze(-1)
    return out


def _holding(episodes: Episodes) -> torch.Tensor:
    """bool [R, T]: the gripper has closed in this episode and is told to stay so: it carries or pushes something."""
    closing = episodes["actions"][..., -1] > 0
    return closing & (~closing).cummax(1).values


def _way(episodes: Episodes) -> torch.Tensor:
    """[R, T + 1]: how far over the table the hand has been told to go until each step, and a little for every step:
    where it goes straight down, what is left of the way is shared evenly."""
    told = episodes["actions"][..., :2].norm(dim=-1) + _STEP
    return F.pad(told.cumsum(1), (1, 0))


def gripper_changes(episodes: Episodes) -> torch.Tensor:
    """bool [R, T]: the executed steps at which the gripper is told otherwise than at the step before."""
    closing, length = episodes["actions"][..., -1] > 0, episodes["length"]
    change = torch.zeros_like(closing)
    change[:, 1:] = closing[:, 1:] != closing[:, :-1]
    return change & (torch.arange(closing.shape[1], device=length.device) < length)


def _next_change(episodes: Episodes) -> torch.Tensor:
    """int64 [R, T]: the first step behind each at which the gripper's command changes, or the episode's end."""
    length = episodes["length"]
    steps = torch.arange(episodes["actions"].shape[1], device=length.device)
    at = torch.where(gripper_changes(episodes), steps, length)
    behind = torch.cat([at[:, 1:], length], 1)  # a change at this very step lies behind the hand
    return behind.flip(1).cummin(1).values.flip(1)
