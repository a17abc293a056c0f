"""The world model as an environment: rollouts without physics."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NonTensorStack, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from worldenv_trl.devices import to_device
from worldenv_trl.envs.contexts import ContextOrder, check_contexts, context_keys
from worldenv_trl.envs.imagined_specs import imagined_specs
from worldenv_trl.envs.imagined_starts import ImaginedStarts
from worldenv_trl.keys import (
    ACTION_DIM,
    CHUNK,
    CONTEXT_ID,
    FRAMES,
    INSTRUCTION,
    KINEMATIC_DIM,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    NOISE_SEED,
    NUM_STEPS,
    POSE_DIM,
    STATE,
    STATE_DIM,
    STATES,
    STEP_MASK,
    TASK_ID,
    frames_key,
    image_entry,
    image_key,
)
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.language import instructions_of
from worldenv_trl.world_models import WorldModel, paint, request
from worldenv_trl.world_models.noise_seeds import noise_seeds

__all__ = ["ImaginedEnv"]


class ImaginedEnv(ImaginedStarts, EnvBase):
    """Rollouts in a video world model (World-Env section 3.2): one decision, a chunk of actions, is one step.

    Forward kinematics predicts the hand's states over the chunk, the world model paints the frames. Reward is 0 and
    nothing terminates here: :class:`~worldenv_trl.envs.Reflect` adds both. Rows are [G, N]: G contexts (initial frame,
    state and instruction), N rollouts of each. The env is batch-locked and honours ``_step``: the world model sees
    active rows only.

    A rollout is a function of (seed, context, rollout index, how often this row was reset, actions), never of the other
    rows: the world model gets a noise seed per row and chunk. Of a rollout's frames those are kept that the world model
    will ask for (its ``memory_indices`` at whole chunks); the others are shown once, in ``frames``.

    Args:
        world_model: paints the active rows. Its cameras, image size and chunk length are the env's.
        kinematics: FK(s, a).
        contexts: TensorDict [K] with the images of the model's cameras, state, kinematic state, task id, context id and
            instruction of K initial states, as :class:`~worldenv_trl.envs.TabletopEnv` writes them at a reset.
        batch_size: [G, N].

    Keyword Args:
        max_steps: env steps after which a rollout is truncated; need not be a multiple of the chunk.
        proprio: ``"commanded"`` writes the accumulated target pose as the state (the same number as in physics),
            ``"measured"`` the pose of the predicted joints.
        seed: of the contexts' order and of the noise; drawn from torch's generator when None.
        device: of the specs and buffers; the contexts' when None. World model and kinematics must be there, too.

    A reset of a whole group draws its next context, the tasks in turn and without replacement while that is possible;
    rows reset while others of their group are running restart their context, so that a group never mixes contexts.
    ``reset(td, set_state=True)`` starts from the contexts in ``td`` [G, N], always with the same noise.

    Examples:
        >>> from worldenv_trl.envs import TabletopEnv
        >>> from worldenv_trl.scenes import load_task
        >>> from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig
        >>> task = load_task("starter/open_the_top_drawer")
        >>> seen_by = {"agentview": {task.language: task.camera("agentview")}}
        >>> model = VideoWorldModel(VideoWorldModelConfig.for_cameras(seen_by, width=16))
        >>> contexts = TabletopEnv(task, 2, seed=0).reset()
        >>> env = ImaginedEnv(model, ForwardKinematics(), contexts, [2, 3], max_steps=16)
        >>> rollouts = env.rollout(2)  # random chunks
        >>> rollouts["next", "frames", "image"].shape, rollouts["next", "truncated"].all(0).squeeze(-1).tolist()
        (torch.Size([2, 3, 2, 8, 3, 64, 64]), [[False, True], [False, True], [False, True]])
    """

    _supports_set_state = True

    def __init__(
        self,
        world_model: WorldModel,
        kinematics: ForwardKinematics,
        contexts: TensorDictBase,
        batch_size: torch.Size | list[int] | tuple[int, int],
        *,
        max_steps: int,
        proprio: str = "commanded",
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        batch = torch.Size([batch_size] if isinstance(batch_size, int) else batch_size)
        if len(batch) != 2 or min(batch) < 1:
            raise ValueError(f"batch_size must be [contexts, rollouts of each], both at least 1, got {batch_size}")
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}")
        if proprio not in ("commanded", "measured"):
            raise ValueError(f'proprio must be "commanded" or "measured", got {proprio!r}')
        device = torch.device(device or contexts.device or "cpu")
        contexts = to_device(contexts, device)
        check_contexts(contexts, kinematics, world_model.cameras, world_model.image_size)
        super().__init__(device=device, batch_size=batch)

        self.world_model, self.kinematics = world_model, kinematics
        self.cameras, self.image_size = tuple(world_model.cameras), world_model.image_size
        self.max_steps, self.chunk_length, self.proprio = int(max_steps), world_model.chunk_length, proprio
        self._contexts = contexts.select(*context_keys(self.cameras)).to(device).contiguous()
        self._instructions = instructions_of(contexts)
        self._order = ContextOrder(contexts)
        specs = imagined_specs(batch, self.cameras, self.image_size, self.chunk_length, self._instructions[0], device)
        self.observation_spec, self.state_spec, self.action_spec, self.reward_spec, self.done_spec = specs
        self._make_buffers()
        self._set_seed(seed)

    # ------------------------------------------------------------------------------------------------- set-up

    def _make_buffers(self) -> None:
        rows, length = self.batch_size.numel(), self.max_steps + self.chunk_length  # the last chunk may overshoot
        image = (3, self.image_size, self.image_size)

        def buffer(name: str, *shape: int, dtype: torch.dtype) -> None:
            self.register_buffer(name, torch.zeros(rows, *shape, dtype=dtype, device=self.device), persistent=False)

        kept, slot = self._remembered(length)
        self.register_buffer("_slot", slot, persistent=False)
        for camera in self.cameras:
            buffer(f"_memory_{camera}", kept, *image, dtype=torch.uint8)
            buffer(f"_image_{camera}", *image, dtype=torch.uint8)
        buffer("_poses", length, POSE_DIM, dtype=torch.float32)
        buffer("_kinematic", 2, KINEMATIC_DIM, dtype=torch.float32)  # at the start, now
        buffer("_state", 2, STATE_DIM, dtype=torch.float32)
        buffer("_task", 1, dtype=torch.int64)
        buffer("_context", 1, dtype=torch.int64)
        buffer("_steps", dtype=torch.int64)
        buffer("_decisions", dtype=torch.int64)
        buffer("_episode", dtype=torch.int64)  # which noise; 0 for contexts given by the caller
        buffer("_resets", dtype=torch.int64)
        self._text = [self._instructions[0]] * rows
        self._text_stack: NonTensorStack | None = None
        self._begun = [False] * self.batch_size[0]  # groups that have a context

    def _remembered(self, length: int) -> tuple[int, Tensor]:
        """How many frames of a rollout the world model will ever ask for, and where each is kept: int64 [length], -1
        for those that are not."""
        decisions = torch.arange(0, self.max_steps, self.chunk_length)
        wanted = torch.cat([torch.zeros(1, dtype=torch.int64), self.world_model.memory_indices(decisions).flatten()])
        numbers = wanted.unique()
        slot = torch.full((length,), -1)
        slot[numbers] = torch.arange(len(numbers))
        return len(numbers), slot.to(self.device)

    # ------------------------------------------------------------------------------------------------- reset

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_: Any) -> TensorDictBase:
        groups, rollouts = self.batch_size
        mask = tensordict.get("_reset", None) if tensordict is not None else None
        if mask is None:
            mask = torch.ones(groups, rollouts, dtype=torch.bool, device=self.device)
        mask = mask.reshape(groups, rollouts).clone()
        full = mask.all(1).tolist()
        whole = [group for group in range(groups) if full[group] or not self._begun[group]]
        mask[whole] = True
        rows = mask.flatten().nonzero().squeeze(-1)
        starts = self._given_starts()
        if set_state or len(whole) < groups:
            starts = None
            self._resets[rows] += 1
        else:
            starts = self.draw_starts() if starts is None else starts
            self._resets.copy_(starts["episode"].flatten())
        if set_state:
            self._load(rows, *self._given(tensordict, rows))
            self._episode[rows] = 0
        else:
            place = self._draw(len(whole)) if starts is None else starts["place"].flatten()
            fresh = torch.tensor(whole, dtype=torch.int64)[:, None] * rollouts + torch.arange(rollouts)
            self._load_places(fresh.flatten().to(self.device), place)
            self._episode[rows] = self._resets[rows]
        self._rewind(rows)
        self._begun = [True] * groups
        out = self._observe()
        out.update(self.full_done_spec.zero())
        return out

    # ------------------------------------------------------------------------------------------------- step

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        chunk = self._checked_chunk(tensordict)
        active = tensordict.get("_step", None)
        active = torch.ones_like(self._steps, dtype=torch.bool) if active is None else active.reshape(-1)
        rows = (active & (self._steps < self.max_steps)).nonzero().squeeze(-1)
        out = self._observe(frames=len(rows) < len(active))
        if len(rows):
            if not bool(chunk[rows].isfinite().all()):
                raise ValueError(f"the action chunk {CHUNK} holds NaN or infinity in an active row")
            self._imagine(rows, chunk[rows].clamp(-1, 1), out)

        truncated = (self._steps >= self.max_steps).view(*self.batch_size, 1)
        out["reward"] = torch.zeros(*self.batch_size, 1, device=self.device)
        for key, value in (("done", truncated), ("terminated", torch.zeros_like(truncated)), ("truncated", truncated)):
            before = tensordict.get(key, None)  # a row that is not stepped keeps its end, whoever decided it
            out[key] = value if before is None else torch.where(active.view_as(value), value, before)
        return out

    def _imagine(self, rows: Tensor, actions: Tensor, out: TensorDictBase) -> None:
        """Advance ``rows`` [n] by the clipped actions [n, C, 7] and write what they see into ``out``."""
        count, length = actions.shape[:2]
        now = self._steps[rows]
        kinematic = self.kinematics.rollout(self._kinematic[rows, 1], actions)
        poses = self.kinematics.pose(kinematic)
        states = self.kinematics.state(kinematic, self.proprio)
        row, seeds = rows.unsqueeze(-1), self._noise_seeds(rows)
        text = [self._text[index] for index in rows.tolist()]
        asked = request(self.world_model, lambda numbers: self._recall(row, numbers), now, poses, actions, text, seeds)
        frames = paint(self.world_model, asked)
        offset = torch.arange(1, length + 1, device=self.device)
        written = now.unsqueeze(-1) + offset
        slot = self._slot[written]
        of, step = (slot >= 0).nonzero(as_tuple=True)
        for camera, video in frames.items():
            self._kept(camera)[rows[of], slot[of, step]] = video[of, step]
        self._poses[row, written] = poses
        executed = (self.max_steps - now).clamp(max=length)  # at least 1: rows at max_steps are not active
        last = torch.arange(count, device=self.device), executed - 1
        self._kinematic[rows, 1], self._state[rows, 1] = kinematic[last], states[last]
        self._steps[rows] += executed
        self._decisions[rows] += 1

        shown = [(frames_key(camera), video) for camera, video in frames.items()]
        shown += [(image_key(camera), video[last]) for camera, video in frames.items()]
        for key, value in (
            *shown,
            (STATES, states),
            (KINEMATIC_STATES, kinematic),
            (STEP_MASK, offset <= executed.unsqueeze(-1)),
            (STATE, states[last]),
            (KINEMATIC_STATE, kinematic[last]),
            (NUM_STEPS, self._steps[rows].unsqueeze(-1)),
            (NOISE_SEED, seeds),
        ):
            if count == self.batch_size.numel():
                out[key] = value.unflatten(0, self.batch_size)
            else:
                out[key].flatten(0, 1)[rows] = value  # a view: written in place
        for camera, video in frames.items():
            self._image(camera)[rows] = video[last]

    def _recall(self, row: Tensor, numbers: Tensor) -> TensorDict:
        """Frames and poses [n, K] of rows [n, 1] by their numbers [n, K]."""
        out = TensorDict({"poses": self._poses[row, numbers]}, batch_size=numbers.shape, device=self.device)
        for camera in self.cameras:
            out[frames_key(camera)] = self._kept(camera)[row, self._slot[numbers]]
        return out

    def _checked_chunk(self, tensordict: TensorDictBase) -> Tensor:
        """The actions [G * N, C, 7] of all rows."""
        expected = (*self.batch_size, self.chunk_length, ACTION_DIM)
        chunk = tensordict.get(CHUNK, None)
        if chunk is None:
            raise ValueError(f"the tensordict holds no action chunk {CHUNK} {expected}: call the policy first")
        if tuple(chunk.shape) != expected or not chunk.is_floating_point():
            raise ValueError(
                f"the action chunk {CHUNK} must be floats {expected}, got {chunk.dtype} {tuple(chunk.shape)}"
            )
        return chunk.detach().to(self.device, torch.float32).flatten(0, 1)

    def _noise_seeds(self, rows: Tensor) -> Tensor:
        parts = (self._context[rows, 0], rows % self.batch_size[1], self._episode[rows], self._decisions[rows])
        return noise_seeds(self._seed, *parts).unsqueeze(-1)

    def _observe(self, *, frames: bool = True) -> TensorDictBase:
        """The current observation of all rows, with an empty chunk: what a reset, or a row not stepped, shows. Without
        ``frames`` where those of all rows are about to be written."""
        batch, chunk, image = self.batch_size, self.chunk_length, (3, self.image_size, self.image_size)
        images = {image_entry(name): self._image(name).clone().unflatten(0, batch) for name in self.cameras}
        if self._text_stack is None:
            self._text_stack = NonTensorStack(*self._text).reshape(batch)

        def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(*batch, chunk, *shape, dtype=dtype, device=self.device)

        out = TensorDict(
            {
                "observation": images | {"state": self._state[:, 1].clone().unflatten(0, batch)},
                KINEMATIC_STATE: self._kinematic[:, 1].clone().unflatten(0, batch),
                TASK_ID: self._task.clone().unflatten(0, batch),
                CONTEXT_ID: self._context.clone().unflatten(0, batch),
                NUM_STEPS: self._steps.clone().view(*batch, 1),
                FRAMES: {image_entry(name): empty(*image, dtype=torch.uint8) for name in self.cameras if frames},
                STATES: empty(STATE_DIM),
                KINEMATIC_STATES: empty(KINEMATIC_DIM),
                NOISE_SEED: torch.zeros(*batch, 1, dtype=torch.int64, device=self.device),
                STEP_MASK: empty(dtype=torch.bool),
            },
            batch_size=batch,
            device=self.device,
        )
        out.set(INSTRUCTION, self._text_stack)
        return out
