"""Recorded or imagined rollouts as episodes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.data.episodes import Episodes
from worldenv_trl.devices import to_device
from worldenv_trl.keys import (
    ACTION,
    CHUNK,
    CONTEXT_ID,
    FRAMES,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    MASK,
    STATE,
    STATES,
    STEP_MASK,
    SUCCESS,
    TASK_ID,
    camera_of,
    frames_key,
    image_key,
)
from worldenv_trl.language import instructions_of

__all__ = ["episodes_from_rollouts"]

_ROOT = (STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID)
_OBSERVED = (("states", STATES, STATE), ("kinematic_states", KINEMATIC_STATES, KINEMATIC_STATE))


def episodes_from_rollouts(rollouts: TensorDictBase) -> Episodes:
    """Episodes from TorchRL rollouts ``[*B, T]``, one action or one chunk a step.

    Step-level rollouts hold ``action`` and images per step (:class:`~worldenv_trl.envs.TabletopEnv`). Decision-level
    ones hold ``("vla_action", "chunk")``, ``step_mask`` and ``frames``, ``states``, ``kinematic_states``
    [*B, T, C, ...] (:class:`~worldenv_trl.envs.ImaginedEnv`, or ``chunked(env, frames=True)``). Entries outside
    ``("collector", "mask")`` are left out; without a mask, those after the first ``done``.

    Decision-level rollouts know success at the last step of each decision; the steps before keep the previous value.
    Episodes are on the CPU, wherever the rollouts are.

    Raises:
        ValueError: naming the entries that are missing, or rollouts in which nothing was executed.
    """
    if rollouts.ndim < 1 or 0 in rollouts.shape:
        raise ValueError(f"rollouts must be [*B, T] with at least one step, got {list(rollouts.shape)}")
    rollouts = to_device(rollouts, torch.device("cpu"))
    rollouts = rollouts.reshape(-1, rollouts.shape[-1]) if rollouts.ndim != 2 else rollouts
    present = set(rollouts.keys(True, True))
    decisions = CHUNK in present and ACTION not in present
    cameras = _cameras(rollouts, decisions)
    needed: list[str | tuple[str, ...]] = [
        CHUNK if decisions else ACTION,
        *_ROOT,
        *(image_key(camera) for camera in cameras),
    ]
    needed += [("next", *_path(key)) for key in (STATES, KINEMATIC_STATES, STEP_MASK)] if decisions else []
    needed += [] if decisions else [("next", *_path(key)) for key in (STATE, KINEMATIC_STATE)]
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

    shown = torch.cat([torch.ones_like(past_end[:, :1]), ~past_end], 1)  # [R, T + 1]
    frames = TensorDict(batch_size=[int(shown.sum())], device=rollouts.device)
    for camera in cameras:
        after = per_step(rollouts["next", *(frames_key(camera) if decisions else image_key(camera))])
        frames[frames_key(camera)] = _from_reset(rollouts[image_key(camera)][:, 0], after, length)[shown]
    return Episodes(out, instructions_of(rollouts[:, 0]), frames)


def _cameras(rollouts: TensorDictBase, decisions: bool) -> list[str]:
    """The cameras whose every frame is known."""
    after = rollouts.get("next", TensorDict())
    below = after.get(FRAMES if decisions else "observation", None)
    if below is None and decisions:
        raise ValueError(
            "these rollouts hold action chunks without the frames in between: collect them with "
            "chunked(env, frames=True), or one action a step"
        )
    images = 6 if decisions else 5  # [R, T, (C,) 3, H, W]
    entries = [] if below is None else [k for k, v in below.items() if v.dtype == torch.uint8 and v.ndim == images]
    if not entries:
        raise ValueError("the rollouts lack images after each step: they cannot be made into episodes")
    return [camera_of(entry) for entry in entries]


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


def _success(rollouts: TensorDictBase, valid: Tensor, per_step: Callable[[Tensor], Tensor], length: Tensor) -> Tensor:
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
