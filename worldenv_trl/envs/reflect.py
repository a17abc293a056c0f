"""The reflector as reward and stop of an environment."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import Transform

from worldenv_trl.keys import (
    FRAMES,
    IMAGE,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    NUM_STEPS,
    STATE,
    STATES,
    STEP_MASK,
    SUCCESS_PROB,
    TASK_ID,
)
from worldenv_trl.reflectors import Reflector

__all__ = ["Reflect"]


class Reflect(Transform):
    """Scores every prefix of a rollout's video and ends the rollout at once when it says that the task is done.

    Over :class:`ImaginedEnv` all frames of a chunk are scored in one batch; the first crossing ends the row *inside*
    the chunk: ``step_mask`` is False behind it, and image, states and ``num_steps`` are those of the crossing frame.
    Over a step-level :class:`TabletopEnv` each frame is scored as it comes (put :func:`chunked` around it, not inside).

    ``reward`` is 0 until the rollout ends, for whatever reason, and then R(o_1:t, g) (World-Env section 3.3);
    ``success_prob`` is the score of the last frame. The first frame, seen before anything was done, never stops a row.

    Args:
        reflector: frozen; its features, not the frames, are kept along a rollout.
        threshold: a frame crosses when its score is above (the paper's 0.5).
        num_frames: most frames of a prefix that are looked at; default: the reflector's own.
        consecutive: crossing frames in a row that end a rollout.

    Raises:
        ValueError: for a threshold outside (0, 1), ``consecutive`` below 1 or ``num_frames`` below 2.
    """

    def __init__(
        self, reflector: Reflector, threshold: float = 0.5, num_frames: int | None = None, consecutive: int = 1
    ) -> None:
        if not 0 < threshold < 1:
            raise ValueError(f"threshold must be in (0, 1), got {threshold}")
        if consecutive < 1:
            raise ValueError(f"consecutive must be at least 1, got {consecutive}")
        if num_frames is not None and num_frames < 2:
            raise ValueError(f"num_frames must be at least 2, the first and the last frame, got {num_frames}")
        super().__init__(in_keys=[IMAGE], out_keys=[SUCCESS_PROB])
        self.reflector = reflector.eval().requires_grad_(False)
        self.num_frames = num_frames
        self.threshold, self.consecutive = float(threshold), int(consecutive)
        # TorchRL steps chunks through shallow copies of this transform: all must remember the same rollouts.
        self._memory: dict[str, Tensor] = {}

    # ------------------------------------------------------------------------------------------------- reset

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        batch, memory = self.parent.batch_size, self._memory
        mask = None if tensordict is None else tensordict.get("_reset", None)
        image = tensordict_reset[IMAGE]
        count = batch.numel()
        if "features" not in memory or memory["features"].shape[0] != count:
            memory["features"] = torch.zeros(count, 1, self.reflector.feature_dim, device=image.device)
            memory["seen"] = torch.zeros(count, dtype=torch.int64, device=image.device)
            memory["streak"] = torch.zeros_like(memory["seen"])
            memory["prob"] = torch.zeros(count, device=image.device)
        rows = torch.arange(count, device=image.device)
        if mask is not None:
            rows = rows[mask.reshape(-1)]
        memory["features"][rows, 0] = self.reflector.encode(image.reshape(-1, *image.shape[-3:])[rows])
        memory["seen"][rows], memory["streak"][rows] = 1, 0
        task = tensordict_reset[TASK_ID].reshape(-1, 1)[rows]
        first = self.reflector.prefix_scores(
            memory["features"][rows, :1], torch.zeros_like(rows), 1, task, self.num_frames
        )
        memory["prob"][rows] = first[:, 0]
        tensordict_reset[SUCCESS_PROB] = memory["prob"].reshape(*batch, 1).clone()
        return tensordict_reset

    # ------------------------------------------------------------------------------------------------- step

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        batch = self.parent.batch_size
        active = tensordict.get("_step", None)
        image = next_tensordict[IMAGE]
        active = (
            torch.ones(batch.numel(), dtype=torch.bool, device=image.device) if active is None else active.reshape(-1)
        )
        rows = active.nonzero().squeeze(-1)
        ended = {name: next_tensordict[name].reshape(-1).clone() for name in ("terminated", "truncated")}
        for name, value in ended.items():  # a row that is not stepped keeps its end, whoever decided it
            before = tensordict.get(name, None)
            if before is not None:
                value[~active] = before.reshape(-1)[~active]
        if len(rows):
            chunk = FRAMES in next_tensordict.keys()  # noqa: SIM118 - a TensorDict iterates over rows
            frames = next_tensordict[FRAMES] if chunk else image.unsqueeze(-4)
            frames = frames.reshape(batch.numel(), *frames.shape[-4:])[rows]  # [n, C, 3, H, W]
            executed = self._executed(next_tensordict, rows, frames.shape[1], chunk)
            stop, last = self._judge(rows, frames, executed, next_tensordict[TASK_ID].reshape(-1, 1)[rows])
            ended["terminated"][rows] |= stop
            ended["truncated"][rows] &= ~stop
            if chunk:
                self._cut(next_tensordict, rows, stop, last, executed)
        done = ended["terminated"] | ended["truncated"]
        shape = (*batch, 1)
        for name, value in (*ended.items(), ("done", done)):
            next_tensordict[name] = value.reshape(shape)
        prob = self._memory["prob"].reshape(shape).clone()
        next_tensordict[SUCCESS_PROB] = prob
        next_tensordict["reward"] = torch.where(done.reshape(shape), prob, 0.0)
        return next_tensordict

    def _executed(self, next_tensordict: TensorDictBase, rows: Tensor, count: int, chunk: bool) -> Tensor:
        if not chunk:
            return torch.ones(len(rows), 1, dtype=torch.bool, device=rows.device)
        return next_tensordict[STEP_MASK].reshape(-1, count)[rows]

    def _judge(self, rows: Tensor, frames: Tensor, executed: Tensor, task_id: Tensor) -> tuple[Tensor, Tensor]:
        """Scores ``frames [n, C]``: whether each row stops ``[n]``, and the index of its last frame ``[n]``."""
        count, memory = frames.shape[1], self._memory
        features = self.reflector.encode(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])
        seen = memory["seen"][rows]
        needed = int(seen.max()) + count
        if memory["features"].shape[1] < needed:
            spare = max(needed, 2 * memory["features"].shape[1]) - memory["features"].shape[1]
            memory["features"] = torch.nn.functional.pad(memory["features"], (0, 0, 0, spare))
        place = seen.unsqueeze(-1) + torch.arange(count, device=rows.device)
        memory["features"][rows.unsqueeze(-1), place] = features
        scores = self.reflector.prefix_scores(memory["features"][rows, :needed], seen, count, task_id, self.num_frames)
        streak, crossed = memory["streak"][rows], []
        for index in range(count):
            streak = torch.where(
                (scores[:, index] > self.threshold) & executed[:, index], streak + 1, torch.zeros_like(streak)
            )
            crossed.append(streak >= self.consecutive)
        crossing = torch.stack(crossed, 1)
        stop = crossing.any(1)
        last = torch.where(stop, crossing.long().argmax(1), executed.sum(1) - 1)
        memory["streak"][rows] = streak
        memory["seen"][rows] = seen + last + 1
        memory["prob"][rows] = scores[torch.arange(len(rows), device=rows.device), last]
        return stop, last

    def _cut(self, out: TensorDictBase, rows: Tensor, stop: Tensor, last: Tensor, executed: Tensor) -> None:
        """Ends the stopped rows at their crossing frame."""
        here, at = rows[stop], last[stop]
        if not len(here):
            return
        batch = self.parent.batch_size
        for whole, one in ((FRAMES, IMAGE), (STATES, STATE), (KINEMATIC_STATES, KINEMATIC_STATE)):
            values = out[one].reshape(batch.numel(), *out[one].shape[len(batch) :]).clone()
            values[here] = out[whole].reshape(batch.numel(), *out[whole].shape[len(batch) :])[here, at]
            out[one] = values.reshape(out[one].shape)
        mask = out[STEP_MASK].reshape(batch.numel(), -1).clone()
        kept = executed[stop] & (torch.arange(mask.shape[1], device=mask.device) <= at.unsqueeze(-1))
        steps = out[NUM_STEPS].reshape(-1, 1).clone()
        steps[here] -= executed[stop].sum(-1, keepdim=True) - kept.sum(-1, keepdim=True)
        mask[here] = kept
        out[STEP_MASK], out[NUM_STEPS] = mask.reshape(out[STEP_MASK].shape), steps.reshape(out[NUM_STEPS].shape)

    # ------------------------------------------------------------------------------------------------- specs

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec[SUCCESS_PROB] = Bounded(
            0.0, 1.0, shape=(*observation_spec.shape, 1), dtype=torch.float32, device=observation_spec.device
        )
        return observation_spec
