"""Episodes: rollouts of any origin in one step-level layout, padded to the longest."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl import keys
from worldenv_trl.kinematics import ForwardKinematics

__all__ = ["concatenate_episodes", "episodes_from_rollouts", "predicted_states"]


def episodes_from_rollouts(rollouts: TensorDictBase) -> TensorDict:
    """Rollouts of :class:`TabletopEnv` (step by step) or :class:`ImaginedEnv` (chunk by chunk) as episodes.

    Args:
        rollouts: ``[*B, T]`` as collectors write them; ``("collector", "mask")`` marks what belongs to a rollout (default:
            everything up to the first ``done``).

    Returns:
        TensorDict ``[R]`` with ``frames`` uint8 [R, L+1, 3, H, W] (o_1 to o_{L+1}), ``states`` [R, L+1, 7],
        ``kinematic_states`` [R, L+1, 20], ``actions`` [R, L, 7] (executed, clipped to [-1, 1]), ``success`` bool [R, L+1]
        (False where the physics was not asked), ``length`` int64 [R, 1] (executed steps), ``task_id``, ``context_id``
        int64 [R, 1]. Entries past an episode's end repeat its last frame and states; actions there are zero.

    Raises:
        ValueError: if no rollout executed a step, or entries are missing.
    """
    rollouts = rollouts.reshape(-1, rollouts.shape[-1])
    missing = [key for key in (keys.IMAGE, keys.STATE, keys.KINEMATIC_STATE, keys.TASK_ID) if rollouts.get(key, None) is None]
    if missing:
        raise ValueError(f"rollouts lack the entries {missing}: they are not rollouts of TabletopEnv or ImaginedEnv")
    mask = _mask(rollouts)
    if ("next", keys.FRAMES) in rollouts.keys(True, True):
        following = {
            "frames": rollouts["next", keys.FRAMES].flatten(1, 2),
            "states": rollouts["next", keys.STATES].flatten(1, 2),
            "kinematic_states": rollouts["next", keys.KINEMATIC_STATES].flatten(1, 2),
        }
        executed = (rollouts["next", keys.STEP_MASK] & mask.unsqueeze(-1)).flatten(1)
        actions = rollouts[keys.CHUNK].flatten(1, 2)
    else:
        following = {
            "frames": rollouts["next", *keys.IMAGE],
            "states": rollouts["next", *keys.STATE],
            "kinematic_states": rollouts["next", keys.KINEMATIC_STATE],
        }
        executed, actions = mask, rollouts[keys.ACTION]
    length = executed.sum(-1)
    if not int(length.max()):
        raise ValueError("no rollout executed a step")
    longest = int(length.max())
    first = {"frames": rollouts[keys.IMAGE], "states": rollouts[keys.STATE], "kinematic_states": rollouts[keys.KINEMATIC_STATE]}
    # Executed steps come first in every row, so an episode's time is the row's own.
    index = torch.minimum(torch.arange(longest + 1, device=length.device), length.unsqueeze(-1))  # [R, L+1], 0 is o_1
    out: dict[str, Tensor] = {}
    for name, values in following.items():
        joined = torch.cat([first[name][:, :1], values[:, :longest]], 1)
        out[name] = joined[torch.arange(len(joined)).unsqueeze(-1), index]
    valid = torch.arange(longest, device=length.device) < length.unsqueeze(-1)
    out["actions"] = torch.where(valid.unsqueeze(-1), actions[:, :longest].clamp(-1, 1), 0.0)
    success = rollouts.get(("next", keys.SUCCESS), None)
    if success is None or ("next", keys.FRAMES) in rollouts.keys(True, True):
        out["success"] = torch.zeros(len(length), longest + 1, dtype=torch.bool)
    else:
        held = torch.cat([torch.zeros(len(length), 1, dtype=torch.bool), success.squeeze(-1)[:, :longest]], 1)
        out["success"] = held.gather(1, index)
    context = rollouts.get(keys.CONTEXT_ID, None)
    out["length"] = length.unsqueeze(-1)
    out[keys.TASK_ID] = rollouts[keys.TASK_ID][:, 0]
    out[keys.CONTEXT_ID] = torch.full_like(out["length"], -1) if context is None else context[:, 0]
    return TensorDict(out, batch_size=[len(length)])


def _mask(rollouts: TensorDictBase) -> Tensor:
    mask = rollouts.get(keys.MASK, None)
    if mask is not None:
        return mask
    done = rollouts["next", "done"].squeeze(-1)
    return (done.cumsum(-1) - done.long()) == 0


def concatenate_episodes(parts: Sequence[TensorDictBase]) -> TensorDict:
    """Several sets of episodes as one, padded to the longest; raises ``ValueError`` for an empty list."""
    if not parts:
        raise ValueError("there are no episodes to concatenate")
    longest = max(part["actions"].shape[1] for part in parts)
    return TensorDict(torch.cat([_extended(part, longest) for part in parts], 0), batch_size=[sum(len(part) for part in parts)])


def _extended(part: TensorDictBase, longest: int) -> TensorDictBase:
    missing = longest - part["actions"].shape[1]
    if not missing:
        return part
    out = part.clone(False)
    for name in ("frames", "states", "kinematic_states", "success"):
        out[name] = torch.cat([part[name], part[name][:, -1:].expand(-1, missing, *part[name].shape[2:])], 1)
    out["actions"] = torch.cat([part["actions"], part["actions"].new_zeros(len(part), missing, part["actions"].shape[-1])], 1)
    return out


@torch.no_grad()
def predicted_states(episodes: TensorDictBase, kinematics: ForwardKinematics) -> Tensor:
    """What FK predicts from each episode's first state and its actions, as imagination does: ``[R, L+1, 20]``."""
    start = episodes["kinematic_states"][:, 0]
    return torch.cat([start.unsqueeze(1), kinematics.rollout(start, episodes["actions"])], 1)
