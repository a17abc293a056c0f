"""Whole action chunks as the actions of a step-level environment."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import MultiAction, TransformedEnv

from worldenv_trl.keys import (
    ACTION,
    ACTION_DIM,
    CHUNK,
    CHUNK_LENGTH,
    FRAMES,
    IMAGE,
    KINEMATIC_DIM,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    STATE,
    STATE_DIM,
    STATES,
    STEP_MASK,
)

__all__ = ["ChunkedActions", "chunked"]

_PER_STEP = ((FRAMES, IMAGE), (STATES, STATE), (KINEMATIC_STATES, KINEMATIC_STATE))


def chunked(env: EnvBase, chunk_length: int = CHUNK_LENGTH, *, frames: bool = False) -> TransformedEnv:
    """An env whose action is a chunk ``("vla_action", "chunk")`` [*B, C, 7]; a step of it is one decision.

    With ``frames`` it writes what :class:`~worldenv_trl.envs.ImaginedEnv` writes, under the same keys; a
    :class:`~worldenv_trl.envs.Reflect` goes around ``env`` first, so that it can stop inside a chunk.
    """
    return TransformedEnv(env, ChunkedActions(chunk_length, frames=frames), auto_unwrap=True)


class ChunkedActions(MultiAction):
    """:class:`~torchrl.envs.transforms.MultiAction` for batch-locked VLA environments, with a fixed chunk length.

    A row that finishes inside a chunk is not stepped further: its remaining entries of ``step_mask`` are False, and
    reward, done flags and observations are those of its last step. (MultiAction loses the reward when every row
    finishes before the last action of a chunk.)

    Args:
        chunk_length: C.
        frames: also write ``frames``, ``states`` and ``kinematic_states`` [*B, C, ...] of the steps that were executed;
            the entries of the others repeat the last one.

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
        self._executed: list[torch.Tensor] = []
        self._shown: dict = {source: [] for _, source in _PER_STEP} if self.frames else {}
        self._reward: torch.Tensor | None = None
        td = tensordict.copy()
        for index in range(self.chunk_length):
            td.set(ACTION, chunk[..., index, :])
            td.set("_step", active)
            self._active = active
            if index == self.chunk_length - 1:
                return td  # the environment around this transform executes the last action
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
        for target, source in _PER_STEP if self.frames else ():
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

    def _entries(self, observation_spec: Composite) -> dict:
        """Specs of the entries that this transform adds."""
        batch, device, length = observation_spec.shape, observation_spec.device, self.chunk_length
        entries = {STEP_MASK: Binary(shape=(*batch, length), dtype=torch.bool, device=device)}
        if self.frames:
            image = observation_spec[IMAGE].shape[len(batch) :]
            entries[FRAMES] = Bounded(0, 255, shape=(*batch, length, *image), dtype=torch.uint8, device=device)
            entries[STATES] = Unbounded(shape=(*batch, length, STATE_DIM), device=device)
            entries[KINEMATIC_STATES] = Unbounded(shape=(*batch, length, KINEMATIC_DIM), device=device)
        return entries

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        action_spec = input_spec["full_action_spec"]
        one = action_spec[ACTION]
        shape = (*one.shape[:-1], self.chunk_length, one.shape[-1])
        del action_spec[ACTION]
        action_spec[CHUNK] = Bounded(-1.0, 1.0, shape=shape, dtype=one.dtype, device=one.device)
        input_spec["full_action_spec"] = action_spec
        return input_spec

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        spec = output_spec["full_observation_spec"]
        for key, entry in self._entries(spec).items():
            spec[key] = entry
        output_spec["full_observation_spec"] = spec
        return output_spec
