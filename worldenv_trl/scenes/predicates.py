"""Goal predicates with LIBERO's meaning, for all rows of a :class:`SceneBatch` at once.

``On(a, b)``: a rests on b and their centres are within 3 cm. LIBERO asks MuJoCo for a contact; here it is read from the
poses, which the batch has for every row at no cost: a's foot is within a millimetre of b's top, and a is level. A bowl
held askew with one edge on the plate does not count yet.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Bowl, Plate

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

ON_DISTANCE = 0.03  # LIBERO: horizontal distance of the centres
TOUCHING = 0.001  # between the foot's lowest point and what is below it
LEVEL = 0.997  # cosine of the tilt: 4.4 degrees


def on(scene: SceneBatch, top: str, bottom: str) -> np.ndarray:
    """``[n]``: the bowl ``top`` rests on the plate ``bottom``."""
    a, b = scene.model.body(f"{top}/").id, scene.model.body(f"{bottom}/").id
    offset = scene.xpos[:, a] - scene.xpos[:, b]
    upright = scene.xmat[:, a].reshape(-1, 9)[:, 8]
    near = np.hypot(offset[:, 0], offset[:, 1]) < ON_DISTANCE
    lowest = offset[:, 2] - Bowl.FOOT_RADIUS * np.sqrt(np.clip(1 - upright**2, 0, None))
    return near & (np.abs(lowest - Plate.TOP) < TOUCHING) & (upright > LEVEL)


def open_(scene: SceneBatch, fixture: str, drawer: str) -> np.ndarray:
    """``[n]``: the drawer is open as LIBERO's wooden cabinet is, past -0.14 m."""
    return _joint(scene, f"{fixture}/{drawer}") < Cabinet.OPEN_BELOW


def turn_on(scene: SceneBatch, fixture: str) -> np.ndarray:
    """``[n]``: the stove's lever is past its threshold."""
    return _joint(scene, f"{fixture}/lever") >= Stove.ON_ABOVE


PREDICATES = {"On": on, "Open": open_, "TurnOn": turn_on}


def _joint(scene: SceneBatch, name: str) -> np.ndarray:
    return scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(name).id]]
