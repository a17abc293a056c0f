"""Whole action chunks as the actions of a step-level environment."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, MultiAction, Transform, TransformedEnv

from worldenv_trl.keys import (
    ACTION,
    ACTION_DIM,
    CHUNK,
    CHUNK_LENGTH,
    FRAMES,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    STATE,
    STATES,
    STEP_MASK,
)

__all__ = ["ChunkedActions", "ChunkedEnv", "chunked"]


def chunked(env: EnvBase, chunk_length: int = CHUNK_LENGTH, *, frames: bool = False) -> ChunkedEnv:
    """An env whose action is a chunk ``("vla_action", "chunk")`` [*B, C, 7]; a step of it is one decision.

    With ``frames`` it writes what :class:`~worldenv_trl.envs.ImaginedEnv` writes, under the same keys, for every camera
    of ``env``; a :class:`~worldenv_trl.envs.Reflect` goes around ``env`` first, so that it can stop inside a chunk.

    Examples:
        >>> from worldenv_trl.envs import TabletopEnv
        >>> env = chunked(TabletopEnv("starter/open_the_top_drawer", 2, cameras=(), max_steps=12, seed=0))
        >>> rollout = env.rollout(2)  # random chunks
        >>> rollout["vla_action", "chunk"].shape, rollout["next", "step_mask"].sum(-1).tolist()
        (torch.Size([2, 2, 8, 7]), [[8, 4], [8, 4]])
    """
    return ChunkedEnv(env, ChunkedActions(chunk_length, frames=frames))


class ChunkedEnv(TransformedEnv):
    """What :func:`chunked` makes; transforms around it stay outside. ``chunk_length`` is C, through them too."""

    @property
    def chunk_length(self) -> int:
        return next(part.chunk_length for part in _parts(self.transform) if isinstance(part, ChunkedActions))

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """A random chunk, also around an env with transforms, of which TorchRL asks a random step."""
        return EnvBase.rand_action(self, tensordict)


def _parts(transform: Transform) -> list[Transform]:
    return list(transform) if isinstance(transform, Compose) else [transform]


def _watched(env: EnvBase) -> bool:
    """Whether a transform of the env looks at its images step by step."""
    while isinstance(env, TransformedEnv):
        keys = {key for part in _parts(env.transform) for key in part.in_keys}
        if any(key == "observation" or (key[0] == "observation" and key != STATE) for key in keys):
            return True
        env = env.base_env
    return False


class ChunkedActions(MultiAction):
    """:class:`~torchrl.envs.transforms.MultiAction` for batch-locked VLA environments, with a fixed chunk length.

    A row that finishes inside a chunk is not stepped further: its remaining entries of ``step_mask`` are False, and
    reward, done flags and observations are those of its last step. (MultiAction loses the reward when every row
    finishes before the last action of a chunk.)

    The chunk's spec is unbounded: a sample of a policy is not clipped, the env clips what it executes.

    Args:
        chunk_length: C.
        frames: also write ``("frames", entry)`` of each camera, ``states`` and ``kinematic_states`` [*B, C, ...] of the
            steps that were executed; the entries of the others repeat the last one.

    Raises:
        ValueError: for a chunk of another shape or dtype.
    """

    def __init__(self, chunk_length: int = CHUNK_LENGTH, *, frames: bool = False) -> None:
        if chunk_length < 1:
            raise ValueError(f"chunk_length must be at least 1, got {chunk_length}")
        super().__init__(stack_rewards=False, action_key=ACTION, chunk_key=CHUNK)
        self.chunk_length, self.frames = chunk_length, frames

    # ------------------------------------------------------------------------------------------------- step

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        parent = self.parent
        chunk = self._checked_chunk(tensordict)
        active = tensordict.get("_step", None)
        active = (
            torch.ones(parent.batch_size, dtype=torch.bool) if active is None else active.reshape(parent.batch_size)
        )
        self._active: torch.Tensor = active
        self._executed: list[torch.Tensor] = []
        self._shown: dict = {source: [] for source in self._per_step(parent.observation_spec).values()}
        self._reward: torch.Tensor | None = None
        td = tensordict.copy()
        undrawn = nullcontext if self.frames or _watched(parent) else getattr(parent, "undrawn", nullcontext)
        for index in range(self.chunk_length):
            td.set(ACTION, chunk[..., index, :])
            td.set("_step", active)
            self._active = active
            if index == self.chunk_length - 1:
                return td  # the environment around this transform executes the last action
            with undrawn():
                td = parent.step(td)
            self._record(td["next"])
            done = td["next", "done"].reshape(active.shape)
            td = parent.step_mdp(td)
            active = active & ~done
            if not active.any():
                break
        # Nothing is left to execute: the env copies its output from the entries that it finds here.
        td.set("_step", active)
        td.set("reward", self._reward)
        if undrawn is not nullcontext:
            td["observation"] = td["observation"].clone(False).update(parent.draw())
        self._write(td)
        return td

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._record(next_tensordict)
        next_tensordict.set("reward", self._reward)
        self._write(next_tensordict)
        return next_tensordict

    def _record(self, shown: TensorDictBase) -> None:
        self._executed.append(self._active)
        reward = shown["reward"]
        executed = self._active.reshape(reward.shape)
        self._reward = reward if self._reward is None else torch.where(executed, reward, self._reward)
        for source, values in self._shown.items():
            values.append(shown[source])

    def _write(self, out: TensorDictBase) -> None:
        dim, missing = self._active.ndim, self.chunk_length - len(self._executed)
        mask = torch.stack(self._executed, dim)
        out.set(STEP_MASK, torch.nn.functional.pad(mask, (0, missing)))
        for target, source in self._per_step(self.parent.observation_spec).items():
            values = self._shown[source]
            out.set(target, torch.stack(values + values[-1:] * missing, dim))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for key, spec in self._entries(self.parent.observation_spec).items():
            tensordict_reset.set(key, spec.zero())
        return tensordict_reset

    def _checked_chunk(self, tensordict: TensorDictBase) -> torch.Tensor:
        chunk = tensordict.get(CHUNK, None)
        expected = (*self.parent.batch_size, self.chunk_length, ACTION_DIM)
        if chunk is None:
            raise ValueError(f"the tensordict holds no action chunk {CHUNK} {list(expected)}: call the policy first")
        if tuple(chunk.shape) != expected or not chunk.is_floating_point():
            raise ValueError(
                f"the action chunk {CHUNK} must be floats {list(expected)}, got {chunk.dtype} {list(chunk.shape)}"
            )
        return chunk

    # ------------------------------------------------------------------------------------------------- specs

    def _per_step(self, observation_spec: Composite) -> dict:
        """What is collected over a chunk: the entry that it is written to, and the one that each step writes."""
        if not self.frames:
            return {}
        seen = observation_spec["observation"]
        images = [entry for entry in seen.keys() if seen[entry].dtype == torch.uint8]  # noqa: SIM118 - no dict
        sources = {(FRAMES, entry): ("observation", entry) for entry in images}
        return {**sources, STATES: STATE, KINEMATIC_STATES: KINEMATIC_STATE}

    def _entries(self, observation_spec: Composite) -> dict:
        """Specs of the entries that this transform adds."""
        batch, device, length = observation_spec.shape, observation_spec.device, self.chunk_length
        entries = {STEP_MASK: Binary(shape=(*batch, length), dtype=torch.bool, device=device)}
        for target, source in self._per_step(observation_spec).items():
            one = observation_spec[source]
            entries[target] = one.unsqueeze(len(batch)).expand(*batch, length, *one.shape[len(batch) :]).clone()
        return entries

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        action_spec = input_spec["full_action_spec"]
        one = action_spec[ACTION]
        shape = (*one.shape[:-1], self.chunk_length, one.shape[-1])
        del action_spec[ACTION]
        action_spec[CHUNK] = Unbounded(shape=shape, dtype=one.dtype, device=one.device)
        input_spec["full_action_spec"] = action_spec
        return input_spec

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        spec = output_spec["full_observation_spec"]
        for key, entry in self._entries(spec).items():
            spec[key] = entry
        output_spec["full_observation_spec"] = spec
        return output_spec
