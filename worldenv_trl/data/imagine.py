"""Recorded actions, imagined: what the world model makes of an episode that the physics has lived."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from tqdm import tqdm

from worldenv_trl.keys import ACTION_DIM, FRAMES, TASK_ID
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.world_models import VideoWorldModel

__all__ = ["imagine_episodes"]

_PADDED_ACTION_DIM = 14  # the world model's dual-arm interface; a single arm fills the first seven


@torch.no_grad()
def imagine_episodes(
    world_model: VideoWorldModel,
    episodes: TensorDictBase,
    kinematics: ForwardKinematics,
    *,
    rows_at_once: int = 64,
    seed: int = 0,
    progress: str | None = None,
) -> TensorDict:
    """The same actions from the same first frames, imagined open loop on the model's own frames.

    Args:
        world_model: paints chunks of ``C`` frames.
        episodes: ``[R]``, see :func:`~worldenv_trl.data.episodes_from_rollouts`.
        kinematics: FK(s, a).

    Keyword Args:
        rows_at_once: episodes in memory at a time.
        seed: of the model's noise, for each episode and chunk.
        progress: label of a progress bar; None shows none.

    Returns:
        ``episodes`` with ``frames`` uint8 [R, T+1, 3, H, W] imagined (the first is real) and ``kinematic_states``
        predicted; ``success`` stays that of the physics under the same actions.
    """
    starts = range(0, len(episodes), rows_at_once)
    parts = [
        _imagine(world_model, episodes[start : start + rows_at_once], kinematics, seed + start)
        for start in tqdm(starts, desc=progress, unit="batch", disable=progress is None)
    ]
    out = episodes.clone(False)
    out["frames"] = torch.cat([frames for frames, _ in parts])
    out["kinematic_states"] = torch.cat([states for _, states in parts])
    return out


def _imagine(
    world_model: VideoWorldModel, episodes: TensorDictBase, kinematics: ForwardKinematics, seed: int
) -> tuple[Tensor, Tensor]:
    rows, steps = episodes["actions"].shape[:2]
    length = world_model.chunk_length
    spare = -steps % length  # the last chunk may reach past the end
    actions = pad(episodes["actions"], (0, 0, 0, spare))
    first = episodes["kinematic_states"][:, 0]
    states = torch.cat([first.unsqueeze(1), kinematics.rollout(first, actions)], 1)
    poses = kinematics.pose(states)
    video = episodes["frames"].new_zeros(rows, steps + spare + 1, *episodes["frames"].shape[2:])
    video[:, 0] = episodes["frames"][:, 0]
    row = torch.arange(rows).unsqueeze(-1)
    for start in range(0, steps, length):
        memory = world_model.memory_indices(torch.full((rows,), start))
        request = TensorDict(
            {
                "memory": {"frames": video[row, memory], "poses": poses[row, memory], "reference": video[:, 0]},
                "poses": poses[:, start + 1 : start + length + 1],
                "padded_actions": pad(actions[:, start : start + length], (0, _PADDED_ACTION_DIM - ACTION_DIM)),
                TASK_ID: episodes[TASK_ID],
                "noise_seed": (seed + row) * 1009 + start,
            },
            batch_size=[rows],
        )
        video[:, start + 1 : start + length + 1] = world_model(request)[FRAMES]
    return video[:, : steps + 1], states[:, : steps + 1]
