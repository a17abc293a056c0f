"""The reflector as reward and stop of an environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NonTensorStack, TensorDict, TensorDictBase, is_leaf_nontensor, is_non_tensor
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform, TransformedEnv

from worldenv_trl.devices import device_of
from worldenv_trl.envs.imagined import ImaginedEnv
from worldenv_trl.keys import (
    FRAMES,
    INSTRUCTION,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    NUM_STEPS,
    STATE,
    STATES,
    STEP_MASK,
    SUCCESS_PROB,
    frames_key,
    image_key,
)
from worldenv_trl.language import instructions_of
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.reflectors.base import check_scores

__all__ = ["Reflect"]


class Reflect(Transform):
    """Scores every prefix of a rollout's video and ends the rollout at once when its rule says that the task is done.

    Over :class:`ImaginedEnv` all frames of a chunk are scored in one batch, and rollouts that begin in the middle of a
    recorded episode are judged as its continuation; the rule ends the row *inside* the chunk:
    ``step_mask`` is False behind it, and images, states and ``num_steps`` are those of the frame that ended it. Over a
    step-level :class:`TabletopEnv` each frame is scored as it comes (put :func:`chunked` around it, not inside). Frames
    go to the reflector's device, scores come back to the env's.

    ``reward`` is 0 until the rollout ends, for whatever reason, and then R(o_1:t, g) (World-Env section 3.3);
    ``success_prob`` is the score of the last frame.

    Args:
        reflector: frozen; its state, not the frames, is kept along a rollout.
        rule: when a score ends a rollout; may be assigned while the rollout runs.

    Attributes:
        stops: False while scores are written and nothing is ended by them; frames in a row are then not counted.

    Raises:
        TypeError: for what is no reflector, or no rule.
        ValueError: when it is put onto an env that does not show what the reflector looks at, or onto imagination that
            the reflector leaves to another one (``for_world``); when a reflector's state or scores are not of the
            videos that it was given, or no probabilities.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from worldenv_trl.envs import TabletopEnv
        >>> from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig
        >>> base = TabletopEnv("starter/open_the_top_drawer", 2, seed=0)
        >>> reflector = CompactReflector(CompactReflectorConfig((base.tasks[0].language,)))
        >>> env = TransformedEnv(base, Reflect(reflector, StopRule(0.99, 2)))
        >>> rollout = env.rollout(3)
        >>> rollout["next", "success_prob"].shape, rollout["next", "reward"].abs().sum().item()
        (torch.Size([2, 3, 1]), 0.0)
    """

    def __init__(self, reflector: Reflector, rule: StopRule = StopRule()) -> None:  # noqa: B008 - frozen
        for name, given, wanted in (("reflector", reflector, Reflector), ("rule", rule, StopRule)):
            if not isinstance(given, wanted):
                raise TypeError(f"{name} must be a {wanted.__name__}, got {type(given).__name__}")
        path = [KINEMATIC_STATE] if reflector.reads_path else []
        super().__init__(in_keys=[*(image_key(camera) for camera in reflector.cameras), *path, INSTRUCTION])
        self.out_keys = [SUCCESS_PROB]
        self.reflector = reflector.eval().requires_grad_(False)
        # TorchRL steps chunks through shallow copies of this transform: all must remember the same rollouts and rule.
        self._memory: dict[str, Any] = {"rule": rule, "stops": True}

    @property
    def rule(self) -> StopRule:
        return self._memory["rule"]

    @rule.setter
    def rule(self, rule: StopRule) -> None:
        self._memory["rule"] = rule

    @property
    def stops(self) -> bool:
        return self._memory["stops"]

    @stops.setter
    def stops(self, stops: bool) -> None:
        self._memory["stops"] = bool(stops)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({type(self.reflector).__name__}, {self.rule}, stops={self.stops})"

    # ------------------------------------------------------------------------------------------------- reset

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        batch, memory = self.parent.batch_size, self._memory
        mask = None if tensordict is None else tensordict.get("_reset", None)
        images = {camera: _by_row(tensordict_reset, image_key(camera)) for camera in self.reflector.cameras}
        if self.reflector.reads_path:
            images[KINEMATIC_STATES] = _by_row(tensordict_reset, KINEMATIC_STATE)
        count, device = batch.numel(), next(iter(images.values())).device
        if "prob" not in memory or len(memory["prob"]) != count:
            mask = None  # rows without a video cannot be left out
            memory["prob"] = torch.zeros(count, device=device)
            memory["streak"] = torch.zeros(count, dtype=torch.int64, device=device)
            memory["state"] = TensorDict(batch_size=[0])
        rows = torch.arange(count, device=device)
        rows = rows if mask is None else rows[mask.reshape(-1)]
        if len(rows):
            goals = instructions_of(tensordict_reset)
            goals = [goals[row] for row in rows.tolist()]
            there = device_of(self.reflector, device)
            state = self.reflector.begin({name: shown[rows].to(there) for name, shown in images.items()}, goals)
            check_scores(self.reflector, "begin", state["score"], (len(rows),))
            memory["state"] = _merged(memory["state"], rows, state, count)
            memory["prob"][rows], memory["streak"][rows] = state["score"].float().to(device), 0
        tensordict_reset[SUCCESS_PROB] = memory["prob"].reshape(*batch, 1).clone()
        return tensordict_reset

    # ------------------------------------------------------------------------------------------------- step

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*self.parent.batch_size, 1)
        ended = {name: next_tensordict[name].reshape(-1).clone() for name in ("terminated", "truncated")}
        active = tensordict.get("_step", None)
        active = torch.ones_like(ended["terminated"]) if active is None else active.reshape(-1)
        for name, value in ended.items():  # a row that is not stepped keeps its end, whoever decided it
            before = tensordict.get(name, None)
            if before is not None:
                value[~active] = before.reshape(-1)[~active]
        chunk = next_tensordict.get(frames_key(self.reflector.cameras[0]), None) is not None
        executed = _by_row(next_tensordict, STEP_MASK) if chunk else torch.ones_like(active).unsqueeze(-1)  # [R, C]
        rows = (active & executed.any(-1)).nonzero().squeeze(-1)
        if len(rows):
            stop, last = self._judge(rows, self._frames(next_tensordict, rows, chunk), executed[rows])
            ended["terminated"][rows] |= stop
            ended["truncated"][rows] &= ~stop
            if chunk:
                self._cut(next_tensordict, rows[stop], last[stop], executed[rows[stop]])
        done = ended["terminated"] | ended["truncated"]
        for name, value in (*ended.items(), ("done", done)):
            next_tensordict[name] = value.reshape(shape)
        prob = self._memory["prob"].reshape(shape).clone()
        next_tensordict[SUCCESS_PROB] = prob
        next_tensordict["reward"] = torch.where(done.reshape(shape), prob, 0.0)
        return next_tensordict

    def _frames(self, shown: TensorDictBase, rows: Tensor, chunk: bool) -> dict[str, Tensor]:
        """What the reflector reads of the new frames of ``rows``: uint8 [n, C, 3, H, W] by camera, and the path."""
        looked_at = self.reflector.cameras if self.reflector.reads_video else ()
        keys: dict[str, tuple[Any, Any]] = {camera: (frames_key(camera), image_key(camera)) for camera in looked_at}
        if self.reflector.reads_path:
            keys[KINEMATIC_STATES] = (KINEMATIC_STATES, KINEMATIC_STATE)
        frames = {}
        for name, (several, one) in keys.items():
            video = _by_row(shown, several) if chunk else _by_row(shown, one).unsqueeze(1)
            video = video if len(rows) == len(video) else video[rows]
            frames[name] = video.to(device_of(self.reflector, video.device))
        return frames

    def _judge(self, rows: Tensor, frames: dict[str, Tensor], executed: Tensor) -> tuple[Tensor, Tensor]:
        """Whether each of the n rows stops, bool [n], and the index in the chunk of its last frame, int64 [n]."""
        memory, whole = self._memory, len(self._memory["prob"])
        # Frames behind a row's end are extended by, too: the row is not stepped again before its reset.
        state, scores = self.reflector.extend(memory["state"] if len(rows) == whole else memory["state"][rows], frames)
        check_scores(self.reflector, "extend", scores, tuple(executed.shape))
        scores = scores.float().to(executed.device)
        memory["state"] = _merged(memory["state"], rows, state, whole)
        stop, last, streak = self.rule.extend(memory["streak"][rows], scores, executed)
        if not self.stops:
            stop, last, streak = torch.zeros_like(stop), executed.sum(1) - 1, torch.zeros_like(streak)
        memory["streak"][rows] = streak
        memory["prob"][rows] = scores.gather(1, last.unsqueeze(-1)).squeeze(-1)
        return stop, last

    def _cut(self, out: TensorDictBase, rows: Tensor, last: Tensor, executed: Tensor) -> None:
        """Ends ``rows`` at frame ``last`` of their chunk."""
        if not len(rows):
            return
        shown = set(out[FRAMES].keys())
        images = [((FRAMES, name), ("observation", name)) for name in out["observation"].keys() if name in shown]  # noqa: SIM118
        for whole, one in (*images, (STATES, STATE), (KINEMATIC_STATES, KINEMATIC_STATE)):
            values = _by_row(out, one).clone()
            values[rows] = _by_row(out, whole)[rows, last]
            out[one] = values.reshape(out[one].shape)
        mask, steps = _by_row(out, STEP_MASK).clone(), out[NUM_STEPS].reshape(-1, 1).clone()
        kept = executed & (torch.arange(mask.shape[1], device=mask.device) <= last.unsqueeze(-1))
        steps[rows] -= executed.sum(-1, keepdim=True) - kept.sum(-1, keepdim=True)
        mask[rows] = kept
        out[STEP_MASK], out[NUM_STEPS] = mask.reshape(out[STEP_MASK].shape), steps.reshape(out[NUM_STEPS].shape)

    # ------------------------------------------------------------------------------------------------- specs

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        parent = self.parent
        if parent is not None:
            try:
                self._check_world(parent)
                self._check_env(parent.observation_spec)
            except ValueError:
                self.reset_parent()  # it may be put onto another env
                raise

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._check_env(observation_spec)
        observation_spec[SUCCESS_PROB] = Bounded(
            0.0, 1.0, shape=(*observation_spec.shape, 1), dtype=torch.float32, device=observation_spec.device
        )
        return observation_spec

    def _check_world(self, env: EnvBase) -> None:
        """Raises ``ValueError`` over imagination that the reflector leaves to another one."""
        while isinstance(env, TransformedEnv):
            env = env.base_env
        judge = self.reflector.for_world("imagined")
        if isinstance(env, ImaginedEnv) and judge is not self.reflector:
            raise ValueError(
                f"the reflector {type(self.reflector).__name__} leaves imagination to its {type(judge).__name__}: pass "
                "reflector.for_world('imagined') to Reflect"
            )

    def _check_env(self, spec: Composite) -> None:
        """Raises ``ValueError`` unless the env shows every camera of the reflector, in its size."""
        reflector, part = self.reflector, type(self.reflector).__name__
        entries = set(spec.keys(True, True))
        key_of = frames_key if STEP_MASK in entries else image_key
        for camera in reflector.cameras:
            if image_key(camera) not in entries:
                images = sorted(name for name, entry in spec["observation"].items() if entry.dtype == torch.uint8)
                raise ValueError(
                    f"the reflector {part} looks at the camera {camera!r} ({image_key(camera)}), which the env does "
                    f"not show (it shows {', '.join(images) or 'no image'}): pass cameras={reflector.cameras} to the "
                    "env, or a reflector that is trained for the env's cameras"
                )
            if key_of(camera) not in entries:
                raise ValueError(
                    f"the env's steps are chunks without the frames {key_of(camera)}: put Reflect onto the step-level "
                    "env and chunked() around it, and whatever leaves out frames behind Reflect"
                )
            size = tuple(spec[key_of(camera)].shape[-2:])
            if reflector.image_size is not None and size != (reflector.image_size, reflector.image_size):
                raise ValueError(
                    f"the reflector {part} looks at frames of {reflector.image_size} px, the env's {key_of(camera)} "
                    f"are {size[0]} x {size[1]} px: pass image_size={reflector.image_size} to the env, or a reflector "
                    "that is trained for that size"
                )


def _by_row(tensordict: TensorDictBase, key: Any) -> Tensor:
    """An entry [*B, ...] as [rows, ...]."""
    value = tensordict[key]
    return value.reshape(-1, *value.shape[tensordict.ndim :])


def _merged(whole: TensorDictBase, rows: Tensor, part: TensorDictBase, count: int) -> TensorDictBase:
    """``whole`` [count] with ``part`` [n] in its ``rows``, ascending; what is shorter along dim 1 is padded with zeros.

    A ``whole`` of other rows is none yet: ``rows`` are then all.
    """
    if len(rows) == count:
        return part
    out = TensorDict(batch_size=[count], device=whole.device)
    for key in part.keys(True, True, is_leaf=is_leaf_nontensor):
        old, new = whole.get(key), part.get(key)
        if isinstance(old, str) or is_non_tensor(old):
            texts, changed = (_texts(value, n) for value, n in ((old, count), (new, len(rows))))
            for row, text in zip(rows.tolist(), changed, strict=True):
                texts[row] = text
            out.set(key, NonTensorStack(*texts))
            continue
        if old.ndim > 1:
            length = max(old.shape[1], new.shape[1])
            old, new = _padded(old, length), _padded(new, length)
        old = old.clone()
        old[rows] = new
        out.set(key, old)
    return out


def _texts(value: Any, count: int) -> list[Any]:
    return [value] * count if isinstance(value, str) else list(value.tolist())


def _padded(values: Tensor, length: int) -> Tensor:
    if values.shape[1] == length:
        return values
    wider = values.new_zeros(values.shape[0], length, *values.shape[2:])
    wider[:, : values.shape[1]] = values
    return wider
