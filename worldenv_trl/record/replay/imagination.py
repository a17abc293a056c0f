"""Recorded actions in a world model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.transforms import TransformedEnv
from torchrl.envs.utils import step_mdp

from worldenv_trl.keys import (
    ACTION_DIM,
    CHUNK,
    CONTEXT_ID,
    FRAMES,
    IMAGE,
    INSTRUCTION,
    KINEMATIC_STATE,
    MASK,
    NOISE_SEED,
    STATE,
    STEP_MASK,
    TASK_ID,
)
from worldenv_trl.record.replay.branch import Branch
from worldenv_trl.record.replay.source import Source, observed

if TYPE_CHECKING:
    from worldenv_trl.reflectors import Reflector

__all__ = ["chunks_of", "replay_imagination"]


def replay_imagination(
    rollouts: TensorDict,
    world_model: TensorDictModuleBase,
    *,
    proprio: str,
    max_steps: int,
    group: int = 1,
    branch: Branch | None = None,
    reflector: Reflector | None = None,
    rule: dict[str, float] | None = None,
) -> TensorDict:
    """Plays the chunks of decision-level ``rollouts`` [R, D] (with a mask) in a world model, all rows together.

    Rows get their recorded noise seeds, if they have some, and take part in just the decisions in which they did: sums
    are rounded as they were. With a ``branch`` (one row), decisions before it show the recorded frames.

    Returns:
        Decision-level entries [R, D'], with a mask.
    """
    from worldenv_trl.envs import ImaginedEnv, Reflect
    from worldenv_trl.kinematics import ForwardKinematics

    chunks, active = rollouts[CHUNK], rollouts[MASK]
    count, length = chunks.shape[0], chunks.shape[2]
    turn = None if branch is None else branch.step // length
    directed = _Directed(world_model, rollouts, turn, branch is not None and branch.seed is not None)
    contexts = rollouts[:, 0].select(IMAGE, STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID, INSTRUCTION, strict=False)
    if INSTRUCTION not in contexts.keys():  # noqa: SIM118 - a TensorDict iterates over rows
        contexts[INSTRUCTION] = NonTensorData("", batch_size=[count])
    words = contexts.get(INSTRUCTION)
    words = [words] * count if isinstance(words, str) else words.tolist()
    contexts[INSTRUCTION] = NonTensorStack(*words)
    seed = 0 if branch is None or branch.seed is None else branch.seed
    env = ImaginedEnv(
        directed,
        ForwardKinematics(),
        contexts,
        [count // group, group],
        max_steps=max_steps,
        chunk_length=length,
        proprio=proprio,
        seed=seed,
    )
    reflect = None if reflector is None else Reflect(reflector, **(rule or {}))
    env = env if reflect is None else TransformedEnv(env, reflect)
    threshold = None if reflect is None else reflect.threshold
    td = env.reset(contexts.reshape(env.batch_size), set_state=True)
    if branch is not None and branch.seed is not None:
        torch.manual_seed(branch.seed)
    until = -(-max_steps // length) if branch is not None and branch.policy is not None else chunks.shape[1]
    entries, masks = [], []
    for decision in range(until):
        behind = turn is not None and decision >= turn
        if reflect is not None and branch is not None:  # before the branch nothing may stop it
            changed = threshold if branch.threshold is None else branch.threshold
            reflect.threshold = changed if behind else float("inf")
        if behind and branch.policy is not None:
            chunk, rows = branch.decide(td).reshape(count, length, ACTION_DIM), torch.ones(count, dtype=torch.bool)
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
    played = torch.stack(entries, -1).reshape(count, len(entries))
    played[MASK] = torch.stack(masks, -1)
    return played


class _Directed(TensorDictModuleBase):
    """A world model that is given recorded noise seeds and, before decision ``turn``, is not asked at all."""

    def __init__(self, model: TensorDictModuleBase, rollouts: TensorDict, turn: int | None, reseeded: bool) -> None:
        super().__init__()
        self.model, self.in_keys, self.out_keys = model, list(getattr(model, "in_keys", [])), [FRAMES]
        for name in ("chunk_length", "image_size"):
            if hasattr(model, name):
                setattr(self, name, getattr(model, name))
        have = set(rollouts.keys(True, True))
        self._seeds = rollouts["next", NOISE_SEED] if ("next", NOISE_SEED) in have else None
        self._frames = rollouts["next", FRAMES] if turn is not None and ("next", FRAMES) in have else None
        self._turn, self._reseeded = turn, reseeded
        self.used = torch.zeros(rollouts.shape[0], 1, dtype=torch.int64)

    def memory_indices(self, steps: Tensor) -> Tensor:
        return self.model.memory_indices(steps)

    def turn_to(self, decision: int, rows: Tensor) -> None:
        """Which decision the next call is of, and of which rows bool [R]."""
        self._decision, self._rows = decision, rows
        self.used = torch.zeros_like(self.used)

    def forward(self, request: TensorDictBase) -> TensorDictBase:
        past = self._turn is not None and self._decision >= self._turn
        if self._seeds is not None and self._decision < self._seeds.shape[1] and not (past and self._reseeded):
            request[NOISE_SEED] = self._seeds[self._rows, self._decision]
        self.used[self._rows] = request[NOISE_SEED].cpu()
        if self._frames is not None and not past:
            return request.set(FRAMES, self._frames[self._rows, self._decision])
        return self.model(request)


def chunks_of(source: Source, length: int) -> TensorDict:
    """A rollout as decisions [1, D] of ``length`` actions: as recorded, or what was executed, in whole chunks.

    Actions that were not recorded, at the end of the last chunk, are zero.
    """
    entries = source.entries
    have = set(entries.keys(True, True))
    if CHUNK in have and entries[CHUNK].shape[1] == length and bool((source.first % length == 0).all()):
        return entries.unsqueeze(0)
    actions = source.actions
    count = -(-len(actions) // length)
    padded = torch.nn.functional.pad(actions, (0, 0, 0, count * length - len(actions)))
    start = entries[:1].select(IMAGE, STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID, INSTRUCTION, strict=False)
    out = start.expand(count).clone()
    executed = torch.arange(count * length).reshape(count, length) < len(actions)
    out[CHUNK], out["next"] = padded.reshape(count, length, -1), TensorDict({STEP_MASK: executed}, [count])
    steps, frames = observed(entries).get("image", (torch.zeros(0), None))
    if len(steps) == len(actions) + 1:  # every frame is known: a branch may start from them
        after = frames[1:][torch.arange(count * length).clamp(max=len(actions) - 1)]
        out["next", FRAMES] = after.unflatten(0, (count, length))
    out[MASK] = torch.ones(count, dtype=torch.bool)
    return out.unsqueeze(0)
