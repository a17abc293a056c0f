"""Scripts for the three starter tasks, whose scenes are not files."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from worldenv_trl.scenes import predicates
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Bowl, Plate
from worldenv_trl.scenes.skills.phase import CLOSE, OPEN, Phase, body, tcp

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch


def _put_on(bowl: str, plate: str) -> list[Phase]:
    def rim(scene: SceneBatch, height: float) -> np.ndarray:
        radius = Bowl.RIM_RADIUS - 0.004
        return np.add(body(scene, bowl), (0.0, radius, height))

    def over_plate(scene: SceneBatch, bottom: float) -> np.ndarray:
        held = tcp(scene) - body(scene, bowl)
        return body(scene, plate) + held + (0.0, 0.0, bottom)

    def held(scene: SceneBatch) -> np.ndarray:
        return np.linalg.norm(tcp(scene) - body(scene, bowl), axis=-1) < 2 * Bowl.RIM_RADIUS

    def placed(scene: SceneBatch) -> np.ndarray:
        return predicates.on(scene, bowl, plate)

    # Deep enough that the pads carry the bowl level; slow at the end, so that it is set down rather than dropped.
    grip = Bowl.HEIGHT - 0.022
    return [
        Phase(lambda s, m: rim(s, 0.11), OPEN, tolerance=0.025),
        Phase(lambda s, m: rim(s, grip), OPEN, tolerance=0.006),
        Phase(lambda s, m: m, CLOSE, tolerance=0.03, dwell=6, remember=lambda s: rim(s, grip)),
        Phase(lambda s, m: m, CLOSE, tolerance=0.02, remember=lambda s: np.add(tcp(s), (0.0, 0.0, 0.07))),
        Phase(lambda s, m: over_plate(s, 0.06), CLOSE, tolerance=0.010, still=held),
        Phase(lambda s, m: over_plate(s, Plate.TOP - 0.001), CLOSE, tolerance=0.005, speed=0.2, still=held),
        Phase(lambda s, m: m, OPEN, tolerance=0.03, dwell=5, remember=tcp),
        Phase(lambda s, m: m, OPEN, remember=lambda s: np.add(tcp(s), (0.0, 0.0, 0.10)), still=placed),
    ]


def _pull_open(cabinet: str, drawer: str) -> list[Phase]:
    def handle(scene: SceneBatch, height: float = 0.0, behind: float = 0.0) -> np.ndarray:
        bar = scene.site_xpos[:, scene.model.site(f"{cabinet}/{drawer}_handle").id]
        return np.add(bar, (0.0, -behind, height))

    def opened(scene: SceneBatch, memory: np.ndarray) -> np.ndarray:
        travel = scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(f"{cabinet}/{drawer}").id]]
        further = np.zeros((len(travel), 3))
        further[:, 1] = travel - Cabinet.OPEN_BELOW
        return handle(scene) + further

    def hooked(scene: SceneBatch) -> np.ndarray:
        x, y, z = (tcp(scene) - handle(scene)).T
        return (np.abs(x) < Cabinet.HANDLE_HALF_WIDTH + 0.008) & (y < 0.0) & (y > -0.065) & (np.abs(z) < 0.025)

    # The closed fingers hook the bar from behind.
    hook = 0.5 * Cabinet.HANDLE_REACH[drawer]
    return [
        Phase(lambda s, m: handle(s, 0.07, hook), CLOSE, tolerance=0.02),
        Phase(lambda s, m: handle(s, 0.0, hook), CLOSE, tolerance=0.008),
        Phase(opened, CLOSE, still=hooked),
    ]


def _push_on(stove: str) -> list[Phase]:
    def along(scene: SceneBatch, ahead: float, height: float) -> np.ndarray:
        lever = scene.qpos[:, scene.model.jnt_qposadr[scene.model.joint(f"{stove}/lever").id]]
        angle = np.minimum(lever + ahead, Stove.ON_ABOVE + 0.25) + Stove.START_ANGLE
        direction = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
        return body(scene, stove) + Stove.PIVOT + Stove.PEG_RADIUS * direction + (0.0, 0.0, height)

    return [
        Phase(lambda s, m: along(s, -0.65, 0.11), CLOSE, tolerance=0.025),
        Phase(lambda s, m: along(s, -0.65, 0.03), CLOSE, tolerance=0.008),
        Phase(lambda s, m: along(s, 0.30, 0.03), CLOSE),
    ]


SCRIPTS: dict[str, Callable[..., list[Phase]]] = {"On": _put_on, "Open": _pull_open, "TurnOn": _push_on}
