"""Training windows of the world model."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl import keys
from worldenv_trl.data.episodes import predicted_states
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.world_models import VideoWorldModel

__all__ = ["WindowSampler", "imagine_episodes"]

_PADDED_ACTION_DIM = 14


class WindowSampler:
    """Random windows of episodes: the memory at a step, and the two chunks that follow.

    Poses are those that FK predicts from the episode's first state, as in imagination, never the true ones.

    Args:
        episodes: ``[R]``, see :func:`episodes_from_rollouts`.
        kinematics: FK(s, a).
        world_model: says which frames it remembers.

    Keyword Args:
        chunks: consecutive chunks in a window.
        seed: of the draws.

    Raises:
        ValueError: if there are no episodes.
    """

    def __init__(
        self,
        episodes: TensorDictBase,
        kinematics: ForwardKinematics,
        world_model: VideoWorldModel,
        *,
        chunks: int = 2,
        seed: int = 0,
    ) -> None:
        if not len(episodes):
            raise ValueError("there are no episodes to train a world model on")
        self.episodes, self.world_model, self.chunks = episodes, world_model, chunks
        self.poses = kinematics.pose(predicted_states(episodes, kinematics))  # [R, L+1, 13]
        self._starts = (torch.arange(episodes["actions"].shape[1]) < episodes["length"]).nonzero()
        self._generator = torch.Generator().manual_seed(seed)

    def sample(self, batch_size: int) -> TensorDict:
        """``batch_size`` windows as :class:`~worldenv_trl.objectives.DiffusionLoss` reads them."""
        drawn = torch.randint(len(self._starts), (batch_size,), generator=self._generator)
        row, step = self._starts[drawn].unbind(-1)
        length = self.chunks * self.world_model.chunk_length
        ahead = step.unsqueeze(-1) + torch.arange(1, length + 1)  # [B, n C]: frames o_{t+1} to o_{t+n C}
        end = self.episodes["length"][row]
        frame = torch.minimum(ahead, end)
        here = row.unsqueeze(-1)
        memory = self.world_model.memory_indices(step)
        actions = self.episodes["actions"][here, torch.minimum(ahead - 1, end - 1)]
        return TensorDict(
            {
                "memory": {
                    "frames": self.episodes["frames"][here, memory],
                    "poses": self.poses[here, memory],
                    "reference": self.episodes["frames"][row, 0],
                },
                "poses": self.poses[here, frame],
                "padded_actions": _padded(actions),
                "target_frames": self.episodes["frames"][here, frame],
                "target_mask": ahead <= end,
                keys.TASK_ID: self.episodes[keys.TASK_ID][row],
            },
            batch_size=[batch_size],
        )


@torch.no_grad()
def imagine_episodes(
    world_model: VideoWorldModel, episodes: TensorDictBase, kinematics: ForwardKinematics, *, rows_at_once: int = 64, seed: int = 0
) -> TensorDict:
    """The same actions from the same first frames, imagined open loop on the model's own frames.

    Args:
        world_model: paints chunks of ``C`` frames.
        episodes: ``[R]``.
        kinematics: FK(s, a).

    Keyword Args:
        rows_at_once: episodes in memory at a time.
        seed: of the model's noise, for each episode and chunk.

    Returns:
        ``episodes`` with ``frames`` uint8 [R, L+1, 3, H, W] imagined (the first is real) and ``kinematic_states``
        predicted; success stays that of the physics under the same actions.
    """
    parts = [
        _imagine(world_model, episodes[start : start + rows_at_once], kinematics, seed + start)
        for start in range(0, len(episodes), rows_at_once)
    ]
    out = episodes.clone(False)
    out["frames"] = torch.cat([frames for frames, _ in parts])
    out["kinematic_states"] = torch.cat([states for _, states in parts])
    return out


def _imagine(world_model: VideoWorldModel, episodes: TensorDictBase, kinematics: ForwardKinematics, seed: int) -> tuple[Tensor, Tensor]:
    rows, steps = episodes["actions"].shape[:2]
    chunk = world_model.chunk_length
    states = predicted_states(episodes, kinematics)
    poses = kinematics.pose(states)
    spare = -(-steps // chunk) * chunk - steps  # the last chunk may reach past the end
    poses = torch.cat([poses, poses[:, -1:].expand(-1, spare, -1)], 1)
    actions = torch.nn.functional.pad(episodes["actions"], (0, 0, 0, spare))
    video = episodes["frames"].new_zeros(rows, steps + spare + 1, *episodes["frames"].shape[2:])
    video[:, 0] = episodes["frames"][:, 0]
    here = torch.arange(rows).unsqueeze(-1)
    for start in range(0, steps, chunk):
        memory = world_model.memory_indices(torch.full((rows,), start))
        request = TensorDict(
            {
                "memory": {"frames": video[here, memory], "poses": poses[here, memory], "reference": video[:, 0]},
                "poses": poses[:, start + 1 : start + chunk + 1],
                "padded_actions": _padded(actions[:, start : start + chunk]),
                keys.TASK_ID: episodes[keys.TASK_ID],
                "noise_seed": (seed + torch.arange(rows).unsqueeze(-1)) * 1009 + start,
            },
            batch_size=[rows],
        )
        video[:, start + 1 : start + chunk + 1] = world_model(request)[keys.FRAMES]
    return video[:, : steps + 1], states


def _padded(actions: Tensor) -> Tensor:
    """Actions [..., 7] in the dual-arm interface [..., 14]; the second arm is idle."""
    return torch.nn.functional.pad(actions, (0, _PADDED_ACTION_DIM - actions.shape[-1]))
