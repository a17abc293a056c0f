"""Goal predicates with LIBERO's meaning, for all rows of a :class:`SceneBatch` at once.

``On(a, b)``: a rests on b and their centres are within 3 cm. LIBERO asks MuJoCo for a contact; here the resting contact
is read from the poses (a upright, its bottom at b's top), which the batch has for every row at no cost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.scenes.objects import Bowl, Cabinet, Plate, Stove

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

ON_DISTANCE = 0.03  # LIBERO: horizontal distance of the centres
RESTING_GAP = 0.004
UPRIGHT = 0.95  # cosine of the tilt


def on(scene: SceneBatch, top: str, bottom: str) -> np.ndarray:
    """``[n]``: the bowl ``top`` rests on the plate ``bottom``."""
    a, b = scene.model.body(f"{top}/").id, scene.model.body(f"{bottom}/").id
    offset = scene.xpos[:, a] - scene.xpos[:, b]
    near = np.hypot(offset[:, 0], offset[:, 1]) < ON_DISTANCE
    resting = np.abs(offset[:, 2] - (Plate.TOP - Bowl.BOTTOM)) < RESTING_GAP
    return near & resting & (scene.xmat[:, a].reshape(-1, 9)[:, 8] > UPRIGHT)


def open_(scene: SceneBatch, fixture: str, drawer: str) -> np.ndarray:
    """``[n]``: the drawer is open as LIBERO's wooden cabinet is, past -0.14 m."""
    return _joint(scene, f"{fixture}/{drawer}") < Cabinet.OPEN_BELOW


def turn_on(scene: SceneBatch, fixture: str) -> np.ndarray:
    """``[n]``: the stove's lever is past its threshold."""
    return _joint(scene, f"{fixture}/lever") >= Stove.ON_ABOVE


PREDICATES = {"On": on, "Open": open_, "TurnOn": turn_on}


def _joint(scene: SceneBatch, name: str) -> np.ndarray:
    return scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(name).id]]
