"""Recorded actions, imagined: what the world model makes of an episode that the physics has lived."""

from __future__ import annotations

import os

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import pad
from tqdm import tqdm

from worldenv_trl.data.episodes import Episodes
from worldenv_trl.data.store import FrameSink
from worldenv_trl.keys import frames_key
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.world_models import WorldModel, request

__all__ = ["imagine_episodes"]


@torch.no_grad()
def imagine_episodes(
    world_model: WorldModel,
    episodes: Episodes,
    kinematics: ForwardKinematics,
    *,
    rows_at_once: int = 16,
    seed: int = 0,
    progress: str | None = None,
    folder: str | os.PathLike | None = None,
) -> Episodes:
    """The same actions from the same first frames, imagined open loop on the model's own frames.

    Args:
        world_model: paints chunks of ``C`` frames.
        episodes: their frames show the model's cameras.
        kinematics: FK(s, a).

    Keyword Args:
        rows_at_once: episodes in memory at a time.
        seed: of the model's noise, for each episode and chunk.
        progress: label of a progress bar; None shows none.
        folder: where the imagined frames go; None keeps them in memory.

    Returns:
        Episodes with the model's cameras alone, whose frames are imagined (the first is real) and whose
        ``kinematic_states`` are predicted; ``success`` stays that of the physics under the same actions.

    Raises:
        ValueError: for episodes that do not show the model's cameras at its size.
        OSError: if the disk of ``folder`` has no room for the frames.
    """
    episodes.require("the world model", world_model.cameras, world_model.image_size)
    sink = FrameSink(int((episodes["length"] + 1).sum()), folder)
    states = []
    for start in tqdm(range(0, len(episodes), rows_at_once), desc=progress, unit="batch", disable=progress is None):
        part = episodes[start : start + rows_at_once]
        video, predicted = _imagine(world_model, part, kinematics, seed + start)
        sink.add(video[part.alive])
        states.append(predicted)
    return episodes.with_video(sink.frames, kinematic_states=torch.cat(states))


def _imagine(
    world_model: WorldModel, episodes: Episodes, kinematics: ForwardKinematics, seed: int
) -> tuple[TensorDict, Tensor]:
    """Video [R, T + 1] and kinematic states [R, T + 1, 20]."""
    rows, steps = episodes["actions"].shape[:2]
    length = world_model.chunk_length
    spare = -steps % length  # the last chunk may reach past the end
    actions = pad(episodes["actions"], (0, 0, 0, spare))
    first = episodes["kinematic_states"][:, 0]
    states = torch.cat([first.unsqueeze(1), kinematics.rollout(first, actions)], 1)
    row = torch.arange(rows).unsqueeze(-1)
    video = TensorDict({"poses": kinematics.pose(states)}, batch_size=[rows, steps + spare + 1])
    for camera in world_model.cameras:
        real = episodes.frames(camera, row[:, 0], torch.zeros(rows, dtype=torch.int64))
        video[frames_key(camera)] = real.new_zeros(*video.batch_size, *real.shape[1:])
        video[frames_key(camera)][:, 0] = real
    for start in range(0, steps, length):
        asked = request(
            world_model,
            lambda numbers: video[row, numbers],
            torch.full((rows,), start),
            video["poses"][:, start + 1 : start + length + 1],
            actions[:, start : start + length],
            episodes.instructions,
            noise_seed=(seed + row) * 1009 + start,
        )
        painted = world_model(asked)
        for camera in world_model.cameras:
            video[frames_key(camera)][:, start + 1 : start + length + 1] = painted[frames_key(camera)]
    return video.exclude("poses")[:, : steps + 1], states[:, : steps + 1]
