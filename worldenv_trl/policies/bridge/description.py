"""What a policy behind the bridge says about itself."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["ActionUnits", "Description"]

ACTION_DIM = 7


@dataclass(frozen=True)
class ActionUnits:
    """What a policy's actions mean. The defaults are LIBERO's and this package's: those are not converted.

    An action is dx dy dz and a rotation vector, in the axes of the robot's base (x forward, z up), and the gripper.

    Args:
        position: metres of an action of +1.
        rotation: radians of an action of +1.
        gripper_open, gripper_closed: the gripper's number for either; OpenVLA's are 1 and 0.
        control_hz: actions a second.

    Raises:
        ValueError: for numbers that are not finite, a step that is not positive, or a gripper that cannot move.
    """

    position: float = 0.05
    rotation: float = 0.5
    gripper_open: float = -1.0
    gripper_closed: float = 1.0
    control_hz: float = 20.0

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not math.isfinite(value) or (not name.startswith("gripper") and value <= 0):
                raise ValueError(f"units: {name} must be a finite{_positive(name)} number, got {value}")
        if self.gripper_open == self.gripper_closed:
            raise ValueError(f"units: gripper_open and gripper_closed must differ, both are {self.gripper_open}")


@dataclass(frozen=True)
class Description:
    """What a served policy is and needs to see: the server's part of the handshake.

    Args:
        name: of the policy, for people and recordings.
        cameras: whose images it reads, named as the scenes name them (``agentview``, ``wrist``).
        image_size: height and width of the images (px).
        chunk_length: C, actions of a decision.
        proprio: what the state tells, ``measured`` or ``commanded`` (the controller's targets).
        instructions: those it is trained on; others are answered with a warning. Empty: it never warns.
        units: of its actions.
        action_range: half the range that it uses of each action dimension, in its own units; exploration reads it.
        digest: of its weights, or whatever else tells it from others of this name.

    Raises:
        ValueError: for what describes no policy.
    """

    name: str
    cameras: tuple[str, ...]
    image_size: int
    chunk_length: int
    proprio: str
    instructions: tuple[str, ...] = ()
    units: ActionUnits = field(default_factory=ActionUnits)
    action_range: tuple[float, ...] = (1.0,) * ACTION_DIM
    digest: str = ""

    def __post_init__(self) -> None:
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise ValueError(f"cameras must name at least one camera, each once, got {self.cameras}")
        if min(self.image_size, self.chunk_length) < 1:
            raise ValueError(
                f"image_size and chunk_length must be at least 1, got {self.image_size} and {self.chunk_length}"
            )
        if self.proprio not in ("commanded", "measured"):
            raise ValueError(f"proprio must be 'commanded' or 'measured', got {self.proprio!r}")
        if len(self.action_range) != ACTION_DIM or not all(math.isfinite(x) and x > 0 for x in self.action_range):
            raise ValueError(f"action_range must be {ACTION_DIM} positive numbers, got {self.action_range}")

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Description:
        """From what JSON holds of one.

        Raises:
            ValueError: if a field is missing, of another type or impossible; unknown ones are left out.
        """
        kinds = {"image_size": int, "chunk_length": int, "units": dict} | dict.fromkeys(
            ("name", "proprio", "digest"), str
        )
        known: dict[str, Any] = {
            each.name: fields[each.name] for each in dataclasses.fields(cls) if each.name in fields
        }
        for name, value in known.items():
            kind = kinds.get(name, (list, tuple))
            if not isinstance(value, kind) or isinstance(value, bool):
                raise ValueError(f"{name} cannot be {value!r}")
        try:
            if "units" in known:
                known["units"] = ActionUnits(**{name: float(value) for name, value in known["units"].items()})
            if "action_range" in known:
                known["action_range"] = tuple(float(value) for value in known["action_range"])
            known |= {name: tuple(map(str, known[name])) for name in ("cameras", "instructions") if name in known}
            return cls(**known)
        except TypeError as error:
            raise ValueError(str(error)) from error


def _positive(name: str) -> str:
    return "" if name.startswith("gripper") else " positive"
