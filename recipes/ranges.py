"""Where each number among the settings must lie."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from operator import attrgetter
from typing import Any

_FARTHEST_SHIFT_M = 0.2
_FARTHEST_PLACE_M = 0.035  # of the radii that policies.PlaceShift has by default


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``, either of which may be left out; NaN lies in none."""

    low: float
    high: float = inf
    above: bool = False
    """Without ``low`` itself."""
    below: bool = False
    """Without ``high`` itself."""
    why: str = ""

    def __contains__(self, value: float) -> bool:
        return (self.low < value if self.above else self.low <= value) and (
            value < self.high if self.below else value <= self.high
        )

    def __str__(self) -> str:
        if self.high == inf:
            text = f"be above {self.low:g}" if self.above else f"be at least {self.low:g}"
            return text + (" and finite" if self.below else "")
        if self.above or self.below:
            return f"lie in {'(' if self.above else '['}{self.low:g}, {self.high:g}{')' if self.below else ']'}"
        return f"lie between {self.low:g} and {self.high:g}"


_ONE, _ZERO = Range(1), Range(0)
_SHARE = Range(0, 1)
_RATE, _WEIGHT = Range(0, above=True, below=True), Range(0, below=True)

RANGES: dict[str, Range] = {
    "seed": _ZERO,
    "num_threads": _ONE,
    "rounds": _ONE,
    "train_states": _ONE,
    "chunk_length": _ONE,
    "max_steps": _ONE,
    "checkpoint_minutes": _WEIGHT,
    "scale_floor": _RATE,
    "scale_share": _SHARE,
    "demonstrate.episodes_per_task": _ONE,
    "sft.steps": _ONE,
    "sft.batch_size": _ONE,
    "sft.lr": _RATE,
    "sft.weight_decay": _WEIGHT,
    "sft.scene_shift_m": Range(0, _FARTHEST_SHIFT_M, why="farther, what rises above the table is shown wrongly"),
    "sft.place_shift_m": Range(0, _FARTHEST_PLACE_M, why="farther, what is around folds over itself"),
    "sft.aim_weight": _WEIGHT,
    "sft.decision_share": _SHARE,
    "sft.scale_steps": _ZERO,
    "sft.scale_lr": _RATE,
    "explore.episodes_per_task": _ONE,
    "explore.scale_factors": _WEIGHT,
    "explore.num_envs": _ONE,
    "world_model.steps": _ONE,
    "world_model.refit_steps": _ONE,
    "world_model.batch_size": _ONE,
    "world_model.lr": _RATE,
    "world_model.weight_decay": _WEIGHT,
    "world_model.unroll_prob": _SHARE,
    "world_model.failure_share": _SHARE,
    "world_model.patch": _ONE,
    "world_model.holdout": _SHARE,
    "reflector.batch_size": _ONE,
    "reflector.lr": _RATE,
    "reflector.imagined_share": _SHARE,
    "reflector.path_epochs": _WEIGHT,
    "reflector.holdout": _SHARE,
    "adapt.steps": _ZERO,
    "adapt.episodes_per_task": _ONE,
    "adapt.batch_size": _ONE,
    "adapt.lr": _RATE,
    "adapt.correct_steps": _ZERO,
    "adapt.correct_lr": _RATE,
    "post_train.iterations": _ONE,
    "post_train.groups": _ONE,
    "post_train.group_size": Range(2),
    "post_train.epochs": _ONE,
    "post_train.minibatch_size": _ONE,
    "post_train.momentum": Range(0, 1, below=True),
    "post_train.clip_epsilon": Range(0, 1, above=True, below=True),
    "post_train.lora_rank": _ZERO,
    "post_train.lora_lr": _WEIGHT,
    "post_train.head_lr": _RATE,
    "post_train.averaging": _SHARE,
    "post_train.draw": _ZERO,
    "post_train.hold": _WEIGHT,
    "post_train.hold_from": _SHARE,
    "post_train.trust": Range(0, 1, below=True),
    "post_train.scale_factor": _RATE,
    "post_train.warmup_iterations": _ZERO,
    "post_train.max_kl": Range(0, above=True),
    "post_train.max_grad_norm": Range(0, above=True),
    "post_train.probe_every": _ZERO,
    "post_train.probe_contexts": _ONE,
    "post_train.false_alarm_rate": Range(0, 1, above=True, below=True),
    "evaluate.episodes_per_task": _ONE,
    "evaluate.num_envs": _ONE,
    "real_size.rows_per_call": _ONE,
    "real_size.num_frames": _ONE,
    "real_size.score_every": _ONE,
}
"""By the settings' names; those that are missing are sizes of the parts, which refuse them when they are made. Of
several numbers each must lie there."""


def check_ranges(config: Any) -> None:
    """Raises ``ValueError`` naming the first setting that lies outside, and where it may lie."""
    for name, allowed in RANGES.items():
        value = attrgetter(name)(config)
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if not all(number in allowed for number in numbers):
            why = f": {allowed.why}" if allowed.why else ""
            raise ValueError(f"{name} must {allowed}, got {value}{why}")
