"""Episodes: the one layout in which recorded or imagined rollouts reach the training stages."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.keys import (
    ACTION,
    CHUNK,
    CONTEXT_ID,
    FRAMES,
    IMAGE,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    MASK,
    STATE,
    STATES,
    STEP_MASK,
    SUCCESS,
    TASK_ID,
)

__all__ = ["concatenate_episodes", "episodes_from_rollouts"]

_ROOT = (IMAGE, STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID)
_OBSERVED = ((FRAMES, FRAMES, IMAGE), (STATES, STATES, STATE), (KINEMATIC_STATES, KINEMATIC_STATES, KINEMATIC_STATE))


def episodes_from_rollouts(rollouts: TensorDictBase) -> TensorDict:
    """Episodes from TorchRL rollouts ``[*B, T]``, one action or one chunk a step.

    Step-level rollouts hold ``action`` and an image per step (:class:`~worldenv_trl.envs.TabletopEnv`). Decision-level
    ones hold ``("vla_action", "chunk")``, ``step_mask`` and ``frames``, ``states``, ``kinematic_states``
    [*B, T, C, ...] (:class:`~worldenv_trl.envs.ImaginedEnv`, or ``chunked(env, frames=True)``). Entries outside
    ``("collector", "mask")`` are left out; without a mask, those after the first ``done``.

    Returns a TensorDict [R], R rollouts, T the steps of the longest one:

    - ``frames`` uint8 [R, T + 1, 3, H, W], ``states`` float32 [R, T + 1, 7], ``kinematic_states`` float32
      [R, T + 1, 20]: from the reset on; past the end of an episode the last one is repeated;
    - ``actions`` float32 [R, T, 7]: executed, clipped to [-1, 1]; zero past the end;
    - ``success`` bool [R, T + 1]: of the physics, repeated past the end; left out where the rollouts carry none
      (imagination). Decision-level rollouts know it at the last step of each decision; the steps before keep the
      previous value;
    - ``length`` int64 [R, 1]: executed steps; ``task_id``, ``context_id`` int64 [R, 1].

    Raises:
        ValueError: naming the entries that are missing, or rollouts in which nothing was executed.
    """
    if rollouts.ndim < 1 or 0 in rollouts.shape:
        raise ValueError(f"rollouts must be [*B, T] with at least one step, got {list(rollouts.shape)}")
    rollouts = rollouts.reshape(-1, rollouts.shape[-1]) if rollouts.ndim != 2 else rollouts
    present = set(rollouts.keys(True, True))
    decisions = CHUNK in present and ACTION not in present
    if decisions and ("next", FRAMES) not in present:
        raise ValueError(
            "these rollouts hold action chunks without the frames in between: collect them with "
            "chunked(env, frames=True), or one action a step"
        )
    needed = [CHUNK if decisions else ACTION, *_ROOT]
    needed += [("next", *_path(key)) for key in (FRAMES, STATES, KINEMATIC_STATES, STEP_MASK)] if decisions else []
    needed += [] if decisions else [("next", *_path(key)) for key in (IMAGE, STATE, KINEMATIC_STATE)]
    missing = [key for key in needed if key not in present]
    if missing:
        raise ValueError(f"the rollouts lack the entries {missing}: they cannot be made into episodes")

    mask = _executed_entries(rollouts)
    valid = mask.unsqueeze(-1)  # [R, D, C], C = 1 for single steps
    if decisions:
        valid = valid & rollouts["next", STEP_MASK]
    order, length = _compaction(valid.flatten(1))
    if not bool(length.any()):
        raise ValueError("the rollouts hold no executed step: their mask is False everywhere")
    steps = int(length.max())
    order = order[:, :steps]
    past_end = torch.arange(steps, device=length.device) >= length  # [R, T]

    def per_step(values: Tensor) -> Tensor:
        """[R, D, (C,) ...] in the order of execution, [R, T, ...]."""
        values = values.flatten(1, 2) if decisions else values
        return values[torch.arange(len(values), device=values.device).unsqueeze(-1), order]

    out = TensorDict(batch_size=[len(rollouts)], device=rollouts.device)
    for name, inside, single in _OBSERVED:
        after = per_step(rollouts["next", *_path(inside if decisions else single)])
        out[name] = _from_reset(rollouts[single][:, 0], after, length)
    actions = per_step(rollouts[CHUNK] if decisions else rollouts[ACTION]).float().clamp(-1, 1)
    out["actions"] = actions.masked_fill(past_end.unsqueeze(-1), 0.0)
    if ("next", SUCCESS) in present:
        out["success"] = _success(rollouts, valid, per_step, length)
    out["length"] = length
    out[TASK_ID], out[CONTEXT_ID] = rollouts[TASK_ID][:, 0].clone(), rollouts[CONTEXT_ID][:, 0].clone()
    return out


def concatenate_episodes(episodes: Sequence[TensorDictBase]) -> TensorDict:
    """Several sets of episodes as one, padded to the longest: observations repeat the last one, actions are zero.

    Raises:
        ValueError: for no episodes at all, or sets with other entries or image sizes.
    """
    episodes = [part for part in episodes if len(part)]
    if not episodes:
        raise ValueError("there are no episodes to concatenate")
    first = episodes[0]
    steps = max(part["actions"].shape[1] for part in episodes)
    for part in episodes[1:]:
        if set(part.keys()) != set(first.keys()):
            names = [sorted(map(str, each.keys())) for each in (first, part)]
            raise ValueError(
                f"episodes hold different entries, {names[0]} and {names[1]}: "
                "episodes of the physics carry success labels, imagined ones none until they are given"
            )
        if part["frames"].shape[2:] != first["frames"].shape[2:]:
            sizes = [list(each["frames"].shape[2:]) for each in (first, part)]
            raise ValueError(f"episodes hold frames of different sizes, {sizes[0]} and {sizes[1]}: record them alike")
    count = sum(len(part) for part in episodes)
    out = TensorDict(batch_size=[count], device=first.device)
    for key in first.keys():  # noqa: SIM118 - a TensorDict iterates over rows
        per_step = key not in ("length", TASK_ID, CONTEXT_ID)
        sample = first[key]
        if not per_step:
            out[key] = torch.cat([part[key] for part in episodes])
            continue
        extra = 0 if key == "actions" else 1
        values = sample.new_zeros(count, steps + extra, *sample.shape[2:])
        start = 0
        for part in episodes:
            rows, have = slice(start, start + len(part)), part[key].shape[1]
            values[rows, :have] = part[key]
            if extra:
                values[rows, have:] = part[key][:, -1:]
            start += len(part)
        out[key] = values
    return out


def _path(key: str | tuple[str, ...]) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def _executed_entries(rollouts: TensorDictBase) -> Tensor:
    """Which entries belong to a rollout: bool [R, T]."""
    mask = rollouts.get(MASK, None)
    if mask is not None:
        return mask.reshape(rollouts.shape).bool()
    done = rollouts.get(("next", "done"), None)
    if done is None:
        return torch.ones(rollouts.shape, dtype=torch.bool, device=rollouts.device)
    done = done.reshape(rollouts.shape).long()
    return (done.cumsum(-1) - done) == 0


def _compaction(valid: Tensor) -> tuple[Tensor, Tensor]:
    """Indices [R, S] that bring the executed steps of [R, S] forward in their order, and their number [R, 1].

    Indices past the number repeat the last executed step.
    """
    length = valid.sum(-1, keepdim=True)
    order = (~valid).to(torch.uint8).argsort(dim=-1, stable=True)
    place = torch.arange(valid.shape[-1], device=valid.device).expand_as(order)
    return order.gather(-1, torch.minimum(place, (length - 1).clamp(min=0))), length


def _from_reset(first: Tensor, after: Tensor, length: Tensor) -> Tensor:
    """[R, ...] at the reset and [R, T, ...] after each step -> [R, T + 1, ...]."""
    out = after.new_empty(after.shape[0], after.shape[1] + 1, *after.shape[2:])
    out[:, 0], out[:, 1:] = first, after
    empty = (length.squeeze(-1) == 0).nonzero().squeeze(-1)
    out[empty] = out[empty, :1].expand_as(out[empty])  # nothing was executed: the reset is all there is
    return out


def _success(rollouts: TensorDictBase, valid: Tensor, per_step, length: Tensor) -> Tensor:
    """bool [R, T + 1]."""
    after = rollouts["next", SUCCESS].reshape(rollouts.shape)
    before = rollouts.get(SUCCESS, None)
    before = torch.zeros_like(after) if before is None else before.reshape(rollouts.shape)
    if valid.shape[-1] == 1:
        steps = per_step(after)
    else:
        place = torch.arange(valid.shape[-1], device=valid.device)
        last = place == valid.sum(-1, keepdim=True) - 1  # [R, D, C]: the decision's last executed step
        steps = per_step(torch.where(last, after.unsqueeze(-1), before.unsqueeze(-1)))
    return _from_reset(before[:, 0], steps, length)
