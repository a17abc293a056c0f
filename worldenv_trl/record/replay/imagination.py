"""Recorded actions in a world model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import TransformedEnv
from torchrl.envs.utils import step_mdp

from worldenv_trl.devices import device_of, to_device
from worldenv_trl.keys import (
    ACTION_DIM,
    CHUNK,
    CONTEXT_ID,
    INSTRUCTION,
    KINEMATIC_STATE,
    MASK,
    NOISE_SEED,
    STATE,
    STEP_MASK,
    TASK_ID,
    frames_key,
    image_entry,
    image_key,
)
from worldenv_trl.language import instructions_of
from worldenv_trl.record.replay.branch import Branch
from worldenv_trl.record.replay.source import Source, observed
from worldenv_trl.world_models import WorldModel

if TYPE_CHECKING:
    from worldenv_trl.reflectors import Reflector, StopRule

__all__ = ["chunks_of", "replay_imagination"]


def replay_imagination(
    rollouts: TensorDict,
    world_model: WorldModel,
    *,
    proprio: str,
    max_steps: int,
    group: int = 1,
    branch: Branch | None = None,
    reflector: Reflector | None = None,
    rule: StopRule | None = None,
) -> TensorDict:
    """Plays the chunks of decision-level ``rollouts`` [R, D] (with a mask) in a world model, all rows together.

    Rows get their recorded noise seeds, if they have some, and take part in just the decisions in which they did: sums
    are rounded as they were. With a ``branch`` (one row), decisions before it show the recorded frames.

    Returns:
        Decision-level entries [R, D'], with a mask, on the CPU; they are made on the world model's device.
    """
    from worldenv_trl.envs import ImaginedEnv, Reflect
    from worldenv_trl.kinematics import ForwardKinematics

    device = device_of(world_model)
    rollouts = to_device(rollouts, device)
    chunks, active = rollouts[CHUNK], rollouts[MASK]
    count, length = chunks.shape[0], chunks.shape[2]
    turn = None if branch is None else branch.step // length
    directed = _Directed(world_model, rollouts, turn, branch is not None and branch.seed is not None)
    contexts = rollouts[:, 0].select(*_context_keys(world_model.cameras), strict=False)
    if INSTRUCTION not in contexts.keys():  # noqa: SIM118 - a TensorDict iterates over rows
        contexts[INSTRUCTION] = NonTensorData("", batch_size=[count])
    contexts[INSTRUCTION] = NonTensorStack(*instructions_of(contexts))
    seed = 0 if branch is None or branch.seed is None else branch.seed
    env = ImaginedEnv(
        directed,
        ForwardKinematics().to(device),
        contexts,
        [count // group, group],
        max_steps=max_steps,
        proprio=proprio,
        seed=seed,
    )
    reflect = None if reflector is None or rule is None else Reflect(reflector, rule)
    env = env if reflect is None else TransformedEnv(env, reflect)
    if branch is not None:
        branch.check_policy(env)
    td = env.reset(contexts.reshape(env.batch_size), set_state=True)
    if branch is not None and branch.seed is not None:
        torch.manual_seed(branch.seed)
    until = -(-max_steps // length) if branch is not None and branch.policy is not None else chunks.shape[1]
    entries, masks = [], []
    for decision in range(until):
        behind = turn is not None and decision >= turn
        if branch is not None:  # it is at a whole decision
            branch.direct(reflect, rule, branch.step if behind else -1)
        if branch is not None and behind and branch.policy is not None:
            chunk, rows = branch.decide(td), torch.ones(count, dtype=torch.bool, device=device)
            if chunk.shape[-2] != length:
                raise ValueError(f"the policy's chunks have {chunk.shape[-2]} actions, the world model's {length}")
            chunk = chunk.reshape(count, length, ACTION_DIM)
        else:
            chunk, rows = chunks[:, decision], active[:, decision]
        if branch is not None and branch.edits:
            chunk = branch.edited(chunk[0], decision * length).unsqueeze(0)
        rows = rows & ~td["done"].reshape(-1)
        if not bool(rows.any()):
            break
        td[CHUNK] = chunk.reshape(*env.batch_size, length, ACTION_DIM)
        directed.turn_to(decision, rows)
        td["_step"] = rows.reshape(env.batch_size)
        out = env.step(td).exclude("_step")
        out["next", NOISE_SEED] = directed.used.reshape(*env.batch_size, 1)
        entries.append(out)
        masks.append(rows)
        td = step_mdp(out, exclude_action=True)
    played: TensorDict = torch.stack(entries, -1).reshape(count, len(entries))
    played[MASK] = torch.stack(masks, -1)
    return to_device(played, torch.device("cpu"))


class _Directed(WorldModel):
    """A world model that is given recorded noise seeds and, before decision ``turn``, is not asked at all."""

    def __init__(self, model: WorldModel, rollouts: TensorDict, turn: int | None, reseeded: bool) -> None:
        super().__init__(cameras=model.cameras, image_size=model.image_size, chunk_length=model.chunk_length)
        self.model, self.seen = model, model.seen  # the same warnings, in its name
        have = set(rollouts.keys(True, True))
        self._seeds = rollouts["next", NOISE_SEED] if ("next", NOISE_SEED) in have else None
        wanted = [frames_key(camera) for camera in model.cameras]
        known = turn is not None and all(("next", *key) in have for key in wanted)
        self._frames = {key: rollouts["next", *key] for key in wanted} if known else {}
        self._turn, self._reseeded = turn, reseeded
        self.used = torch.zeros(rollouts.shape[0], 1, dtype=torch.int64, device=rollouts[CHUNK].device)

    def memory_indices(self, now: Tensor) -> Tensor:
        return self.model.memory_indices(now)

    def turn_to(self, decision: int, rows: Tensor) -> None:
        """Which decision the next call is of, and of which rows bool [R]."""
        self._decision, self._rows = decision, rows
        self.used = torch.zeros_like(self.used)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        past = self._turn is not None and self._decision >= self._turn
        if self._seeds is not None and self._decision < self._seeds.shape[1] and not (past and self._reseeded):
            tensordict[NOISE_SEED] = self._seeds[self._rows, self._decision]
        self.used[self._rows] = tensordict[NOISE_SEED]
        if not self._frames or past:
            return self.model(tensordict)
        for key, frames in self._frames.items():
            tensordict[key] = frames[self._rows, self._decision]
        return tensordict


def chunks_of(source: Source, length: int, cameras: Sequence[str]) -> TensorDict:
    """A rollout as decisions [1, D] of ``length`` actions: as recorded, or what was executed, in whole chunks.

    Actions that were not recorded, at the end of the last chunk, are zero.

    Raises:
        ValueError: if the rollout does not show one of ``cameras``.
    """
    entries = source.entries
    have = set(entries.keys(True, True))
    missing = [camera for camera in cameras if image_key(camera) not in have]
    if missing:
        raise ValueError(
            f"the world model paints {', '.join(cameras)}, but rollout {source.number} of {source.path} shows "
            f"{', '.join(source.cameras) or 'no camera'}: it cannot be imagined by this model"
        )
    if CHUNK in have and entries[CHUNK].shape[1] == length and bool((source.first % length == 0).all()):
        return entries.unsqueeze(0)
    actions = source.actions
    count = -(-len(actions) // length)
    padded = torch.nn.functional.pad(actions, (0, 0, 0, count * length - len(actions)))
    start = entries[:1].select(*_context_keys(cameras), strict=False)
    out = start.expand(count).clone()
    executed = torch.arange(count * length).reshape(count, length) < len(actions)
    out[CHUNK], out["next"] = padded.reshape(count, length, -1), TensorDict({STEP_MASK: executed}, [count])
    seen = observed(entries)
    for camera in cameras:
        steps, frames = seen[image_entry(camera)]
        if len(steps) == len(actions) + 1:  # every frame is known: a branch may start from them
            after = frames[1:][torch.arange(count * length).clamp(max=len(actions) - 1)]
            out["next", *frames_key(camera)] = after.unflatten(0, (count, length))
    out[MASK] = torch.ones(count, dtype=torch.bool)
    return out.unsqueeze(0)


def _context_keys(cameras: Sequence[str]) -> list[str | tuple[str, ...]]:
    """What an imagined rollout starts from."""
    return [*map(image_key, cameras), STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID, INSTRUCTION]
