"""Recorded actions, imagined: what the world model makes of an episode that the physics has lived."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import pad
from tqdm import tqdm

from worldenv_trl.data.episodes import Episodes
from worldenv_trl.data.store import FrameSink
from worldenv_trl.devices import device_of, to_device
from worldenv_trl.keys import frames_key
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.world_models import WorldModel, paint, request
from worldenv_trl.world_models.noise_seeds import noise_seeds

__all__ = ["imagine_episodes"]


@torch.no_grad()
def imagine_episodes(
    world_model: WorldModel,
    episodes: Episodes,
    kinematics: ForwardKinematics,
    *,
    shown_chunks: int | None = 1,
    painted: Episodes | None = None,
    rows_at_once: int = 16,
    seed: int = 0,
    progress: str | None = None,
    folder: str | os.PathLike | None = None,
    batches: Callable[[int, ImaginedSoFar], Iterable[int]] | None = None,
) -> Episodes:
    """The same actions from the same first frames, imagined open loop on the model's own frames.

    With more ``shown_chunks`` the model is told the truth for longer: so many chunks, from the first on, are painted
    with the recorded frames before them as the model's memory, the later ones with its own. What is seen is always what
    it painted. Between 1, imagination, and None, every chunk from a real past, lies what drift costs.

    Args:
        world_model: paints chunks of ``C`` frames.
        episodes: their frames show the model's cameras; on the CPU, as what is made of them.
        kinematics: FK(s, a); where it is, on the device of the model, is imagined.

    Keyword Args:
        shown_chunks: see above, at least 1 (the first chunk has nothing but the recorded frame); None is all.
        painted: these episodes as the same model imagined them with at least as many shown chunks (and the same seed):
            the shown chunks are taken from there instead of being painted again.
        rows_at_once: episodes in memory at a time.
        seed: of the model's noise, for each episode and chunk.
        progress: label of a progress bar; None shows none.
        folder: where the imagined frames go; None keeps them in memory.
        batches: of how many there are, and of what holds those that are done, gives the numbers of those that are
            left: for work that is interrupted and continued in the same ``folder``.

    Returns:
        Episodes with the model's cameras alone, whose frames are imagined (the first is real) and whose
        ``kinematic_states`` are predicted; ``success`` stays that of the physics under the same actions.

    Raises:
        ValueError: for episodes that do not show the model's cameras at its size, ``shown_chunks`` below 1 or
            ``painted`` of another number.
        OSError: if the disk of ``folder`` has no room for the frames.
    """
    episodes.require("the world model", world_model.cameras, world_model.image_size)
    if shown_chunks is not None and shown_chunks < 1:
        raise ValueError(f"shown_chunks must be at least 1, got {shown_chunks}")
    if painted is not None:
        if len(painted) != len(episodes):
            raise ValueError(f"painted must be the same {len(episodes)} episodes, got {len(painted)}")
        painted.require("the world model", world_model.cameras, world_model.image_size)
    shown = -(-episodes["actions"].shape[1] // world_model.chunk_length) if shown_chunks is None else shown_chunks
    made = ImaginedSoFar(FrameSink(int((episodes["length"] + 1).sum()), folder))
    count = -(-len(episodes) // rows_at_once)
    if batches is None:
        left: Iterable[int] = tqdm(range(count), desc=progress, unit="batch", disable=progress is None)
    else:
        left = batches(count, made)
    for batch in left:
        part = slice(batch * rows_at_once, (batch + 1) * rows_at_once)
        known = None if painted is None else painted[part]
        numbers = torch.arange(len(episodes))[part]
        video, predicted = _imagine(world_model, episodes[part], kinematics, seed, numbers, shown, known)
        made.sink.add(video[episodes[part].alive])
        made.states.append(predicted)
    return episodes.with_video(made.sink.frames, kinematic_states=torch.cat(made.states))


class ImaginedSoFar:
    """The frames and the predicted kinematic states [R, T + 1, 20] of the batches that are done.

    Its state names the frames, which stay in the folder of the ``sink``; loading it raises ``ValueError``, and changes
    nothing, where they are not there any more.
    """

    def __init__(self, sink: FrameSink) -> None:
        self.sink, self.states = sink, list[Tensor]()

    def state_dict(self) -> dict[str, Any]:
        return {"frames": self.sink.state_dict(), "states": torch.cat(self.states) if self.states else None}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.sink.load_state_dict(state_dict["frames"])
        self.states = [] if state_dict["states"] is None else [state_dict["states"]]


def _imagine(
    world_model: WorldModel,
    episodes: Episodes,
    kinematics: ForwardKinematics,
    seed: int,
    numbers: Tensor,
    shown: int,
    painted: Episodes | None,
) -> tuple[TensorDict, Tensor]:
    """Video [R, T + 1] and kinematic states [R, T + 1, 20] of the episodes with these ``numbers`` [R]."""
    rows, steps = episodes["actions"].shape[:2]
    length, device = world_model.chunk_length, device_of(kinematics)
    spare = -steps % length  # the last chunk may reach past the end
    actions = pad(episodes["actions"], (0, 0, 0, spare)).to(device)
    first = episodes["kinematic_states"][:, 0].to(device)
    states = torch.cat([first.unsqueeze(1), kinematics.rollout(first, actions)], 1)
    row = torch.arange(rows).unsqueeze(-1)  # of episodes, which are on the CPU; an index may be there, too
    video = TensorDict({"poses": kinematics.pose(states)}, batch_size=[rows, steps + spare + 1])
    for camera in world_model.cameras:
        real = episodes.frames(camera, row[:, 0], torch.zeros(rows, dtype=torch.int64)).to(device)
        video[frames_key(camera)] = real.new_zeros(*video.batch_size, *real.shape[1:])
        video[frames_key(camera)][:, 0] = real
    real_until = min(shown - 1, steps // length) * length  # the last frame of which a real one is remembered
    truth = video.clone() if real_until else video
    for camera in world_model.cameras if real_until else ():
        real = episodes.frames(camera, row, torch.arange(real_until + 1))
        truth[frames_key(camera)][:, : real_until + 1] = real.to(device)
    for start in range(0, steps, length):
        chunk = torch.arange(start + 1, start + length + 1)
        if painted is not None and start < shown * length:
            for camera in world_model.cameras:
                video[frames_key(camera)][:, chunk] = painted.frames(camera, row, chunk).to(device)
            continue
        memory = truth if start <= real_until else video
        asked = request(
            world_model,
            partial(_recall, memory, row),
            torch.full((rows,), start, device=device),
            video["poses"][:, chunk],
            actions[:, chunk - 1],
            episodes.instructions,
            noise_seed=noise_seeds(seed, numbers, torch.full_like(numbers, start)).unsqueeze(-1).to(device),
        )
        for camera, frames in paint(world_model, asked).items():
            video[frames_key(camera)][:, chunk] = frames
    seen = to_device(video.exclude("poses")[:, : steps + 1], torch.device("cpu"))
    return seen, states[:, : steps + 1].cpu()


def _recall(video: TensorDict, row: Tensor, numbers: Tensor) -> TensorDict:
    """Frames and poses [R, K] by their numbers [R, K]."""
    return video[row.to(numbers.device), numbers]
