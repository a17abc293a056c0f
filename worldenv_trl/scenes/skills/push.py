"""Push a flat thing over the table."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.skills.clearance import travel
from worldenv_trl.scenes.skills.phase import FINGER_HALF, OPEN, Phase, body, half_turn, tcp, upwards

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

_FORK = 0.042  # half the distance of the points where two open fingers touch
_LOW = 0.012  # height of the point between the fingertips while it pushes
_AHEAD = 0.03  # how far the hand aims beyond where it is


def push_to(task: FileTask, thing: str, place: str, again: int) -> list[Phase]:
    """Phases that push ``thing`` with open fingers, one on either side, until it lies at ``place``'s centre.

    Two points of contact keep a round thing from slipping away sideways.
    """
    owner, part = task.relations.part(place)
    radius = task.entities[thing].radius
    behind = float(np.sqrt(max(radius**2 - _FORK**2, 0.0))) + FINGER_HALF

    def way(scene: SceneBatch) -> tuple[np.ndarray, np.ndarray]:
        """Direction ``[n, 3]`` and distance ``[n, 1]`` to the goal."""
        rest = task.relations.box(scene, owner, part)[0] - body(scene, thing)
        rest = rest * (1.0, 1.0, 0.0)
        distance = np.linalg.norm(rest, axis=-1, keepdims=True)
        return rest / np.maximum(distance, 1e-6), distance

    def start(scene: SceneBatch, height: float) -> np.ndarray:
        return body(scene, thing) - (behind + 0.03) * way(scene)[0] + (0.0, 0.0, height)

    def push(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        direction, distance = way(scene)
        return body(scene, thing) + (np.minimum(distance, _AHEAD) - behind) * direction + (0.0, 0.0, _LOW)

    def yaw(scene: SceneBatch) -> np.ndarray:
        direction = way(scene)[0]
        return half_turn(np.arctan2(direction[:, 1], direction[:, 0]))

    def there(scene: SceneBatch) -> np.ndarray:
        return way(scene)[1][:, 0] < 0.04

    phases = [
        Phase(lambda s, m: travel(s, task, start(s, 0.10)), OPEN, tolerance=0.02, limit=40, yaw=yaw),
        Phase(lambda s, m: start(s, _LOW), OPEN, tolerance=0.008, yaw=yaw),
        Phase(push, OPEN, tolerance=0.010, speed=0.3, limit=60),
        Phase(lambda s, m: m + upwards(0.08), OPEN, tolerance=0.02, remember=tcp, still=there),
    ]
    return [replace(phase, again=again) for phase in phases]
