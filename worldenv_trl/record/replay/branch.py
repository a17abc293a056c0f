"""What is changed in a what-if: where it branches off, who acts from there, which actions are edited."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl.keys import ACTION_DIM, CHUNK

if TYPE_CHECKING:
    from worldenv_trl.envs import Reflect
    from worldenv_trl.reflectors import StopRule

__all__ = ["ACTION_NAMES", "Branch", "parse_edit"]

ACTION_NAMES = ("dx", "dy", "dz", "rx", "ry", "rz", "gripper")
_EDIT = re.compile(r"(\d+)(?:-(\d+))?((?:\s+\w+=[-+.\deE]+)+)\s*")


@dataclass(frozen=True)
class Branch:
    """A change from env step ``step`` on (the action that leads from it to the next is the first that may differ).

    Args:
        step: where it branches off.
        policy: acts from there on; the recorded actions go on without.
        seed: of its samples and of the world model's noise from there on; a policy without seed is greedy.
        threshold: the reflector's, from there on.
        edits: {step: {action dimension: value}}, made to whatever action is executed then.
    """

    step: int
    policy: TensorDictModuleBase | None = None
    seed: int | None = None
    threshold: float | None = None
    edits: Mapping[int, Mapping[int, float]] = field(default_factory=dict)

    @property
    def changes(self) -> bool:
        return bool(self.policy is not None or self.seed is not None or self.threshold is not None or self.edits)

    def direct(self, reflect: Reflect | None, rule: StopRule | None, step: int) -> None:
        """Sets how the action of env step ``step`` may end the rollout: before the branch not at all, then by ``rule``,
        with the branch's threshold."""
        if reflect is not None and rule is not None:
            reflect.stops = step >= self.step
            reflect.rule = rule if self.threshold is None else replace(rule, threshold=self.threshold)

    def edited(self, actions: Tensor, first: int) -> Tensor:
        """Actions [n, 7] of the steps from ``first`` on, with the edits."""
        out = actions
        for step, values in self.edits.items():
            if first <= step < first + len(actions):
                out = out.clone() if out is actions else out
                for dimension, value in values.items():
                    out[step - first, dimension] = value
        return out

    def check_policy(self, env: EnvBase) -> None:
        """Raises ``ValueError`` if the policy was not trained for what ``env`` shows and executes."""
        if not isinstance(self.policy, nn.Module):
            return
        from worldenv_trl.policies import Policy, check_pairing  # reading needs no policies

        for part in self.policy.modules():
            if isinstance(part, Policy):
                check_pairing(part, env)

    @torch.no_grad()
    def decide(self, tensordict: TensorDictBase) -> Tensor:
        """The policy's chunk [*B, C, 7]."""
        from worldenv_trl.policies import DeviceBridge  # reading needs no policies

        assert self.policy is not None
        acting = DeviceBridge(self.policy) if isinstance(self.policy, TensorDictModuleBase) else self.policy
        mode = ExplorationType.DETERMINISTIC if self.seed is None else ExplorationType.RANDOM
        training = [m for m in self.policy.modules() if m.training] if isinstance(self.policy, nn.Module) else []
        try:
            for module in training:
                module.training = False
            with set_exploration_type(mode):
                return acting(tensordict.copy())[CHUNK]
        finally:
            for module in training:
                module.training = True

    def describe(self) -> dict[str, Any]:
        """Plain values for a file's metadata."""
        from worldenv_trl.record.mcap.provenance import model_hash

        words: list[str] = []
        out: dict[str, Any] = {"step": self.step}
        if self.policy is not None:
            out["policy"] = model_hash(self.policy)
            words.append(f"policy {out['policy'][:8]}, {'greedy' if self.seed is None else 'sampled'}")
        if self.seed is not None:
            out["seed"] = self.seed
            words.append(f"seed {self.seed}")
        if self.threshold is not None:
            out["threshold"] = self.threshold
            words.append(f"reflector's threshold {self.threshold:g}")
        if self.edits:
            out["edits"] = {str(k): {ACTION_NAMES[d]: v for d, v in e.items()} for k, e in self.edits.items()}
            words += [
                f"action of step {k}: " + ", ".join(f"{n} = {v:g}" for n, v in e.items())
                for k, e in list(out["edits"].items())[:3]
            ]
            if len(out["edits"]) > 3:
                words.append(f"and {len(out['edits']) - 3} more edited actions")
        return out | {"change": "; ".join(words)}


def parse_edit(text: str) -> dict[int, dict[int, float]]:
    """Edits from ``"43 gripper=-1"`` or ``"40-47 dz=0.5 gripper=1"``.

    Raises:
        ValueError: for another form, an unknown dimension or a value outside [-1, 1].
    """
    found = _EDIT.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"an edit reads like '43 gripper=-1' or '40-47 dz=0.5 gripper=1', got {text!r}")
    first, last = int(found[1]), int(found[2] or found[1])
    values: dict[int, float] = {}
    for part in found[3].split():
        name, _, number = part.partition("=")
        if name not in ACTION_NAMES:
            raise ValueError(f"an action has the dimensions {', '.join(ACTION_NAMES)}, not {name!r}")
        try:
            values[ACTION_NAMES.index(name)] = float(number)
        except ValueError as error:
            raise ValueError(f"{number!r} is no number, in the edit {text!r}") from error
    check_edits({first: values})
    if last < first:
        raise ValueError(f"the steps of the edit {text!r} run backwards")
    return {step: dict(values) for step in range(first, last + 1)}


def check_edits(edits: Mapping[int, Mapping[int, float]]) -> None:
    for step, values in edits.items():
        for dimension, value in values.items():
            if not 0 <= dimension < ACTION_DIM:
                raise ValueError(f"an action has {ACTION_DIM} dimensions, the edit of step {step} names {dimension}")
            if not -1 <= value <= 1:
                raise ValueError(f"actions lie in [-1, 1], the edit of step {step} says {value}")
