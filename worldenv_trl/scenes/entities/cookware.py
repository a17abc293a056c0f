"""Pots, pans and the stove they stand on."""

from __future__ import annotations

import math
from typing import Any

import mujoco
from dm_control import mjcf

from worldenv_trl.scenes.canvas import Glow
from worldenv_trl.scenes.entities.base import GHOST, Grasp, JointState, Primitive
from worldenv_trl.scenes.materials import WORN


class FryingPan(Primitive):
    """A pan, 0.17 m across, with a long handle towards +x; graspable by the handle."""

    radius, height = 0.13, 0.037
    footprint = (0.21, 0.085)
    grasp = Grasp((0.125, 0.0, 0.030))

    def _shape(self, body: mjcf.Element) -> None:
        iron: dict[str, Any] = {"rgba": (0.16, 0.16, 0.18, 1)}
        inside: dict[str, Any] = {"rgba": (0.46, 0.47, 0.50, 1), **WORN.of(self._root)}
        self._disc(body, 0.078, 0.0, 0.006, mass=0.20, **iron)
        self._disc(body, 0.070, 0.0005, 0.0066, **GHOST, **inside)
        self._ring(body, 0.076, 0.083, 0.0, 0.035, mass=0.008, **iron)
        self._box(body, (0.145, 0, 0.030), (0.065, 0.009, 0.007), mass=0.05, rgba=(0.60, 0.28, 0.12, 1))
        self._mark(body, "center", (0, 0, 0))


class MokaPot(Primitive):
    """A coffee maker: waisted, with a handle towards +x; graspable around its upper half."""

    radius, height = 0.06, 0.124
    grasp = Grasp((0.0, 0.0, 0.098))

    def _shape(self, body: mjcf.Element) -> None:
        steel, black = {"rgba": (0.72, 0.74, 0.78, 1)}, {"rgba": (0.10, 0.10, 0.11, 1)}
        self._disc(body, 0.040, 0.0, 0.050, mass=0.06, **steel)
        self._disc(body, 0.027, 0.050, 0.068, mass=0.02, **steel)
        self._disc(body, 0.034, 0.068, 0.115, mass=0.04, **steel)
        self._disc(body, 0.010, 0.115, 0.124, mass=0.005, **black)
        for z in (0.075, 0.108):
            self._box(body, (0.045, 0, z), (0.014, 0.005, 0.004), mass=0.005, **black)
        self._box(body, (0.057, 0, 0.088), (0.005, 0.006, 0.024), mass=0.01, **black)
        self._mark(body, "center", (0, 0, 0))


class Stove(Primitive):
    """A flat stove with one burner and a lever; joint ``lever`` turns from 0 (off) to 1.7 rad.

    The burner glows when on.
    """

    ON_ABOVE = 1.05  # sixty degrees
    PEG_RADIUS = 0.085  # lever axis to the peg that is pushed
    PIVOT = (-0.045, 0.0, 0.035)
    PEG_HEIGHT = 0.05
    START_ANGLE = -math.pi / 2  # direction of the lever (from +x) when off
    BURNER, BURNER_RADIUS, COOKS_WITHIN = (0.075, 0.0), 0.055, 0.05
    radius, height = 0.18, 0.085
    footprint = (0.14, 0.12)

    def _shape(self, body: mjcf.Element) -> None:
        self._box(body, (0, 0, 0.0125), (0.14, 0.12, 0.0125), rgba=(0.78, 0.80, 0.83, 1))
        body.add(
            "geom", name="burner", type="cylinder", pos=(*self.BURNER, 0.0275), size=(self.BURNER_RADIUS, 0.003),
            rgba=(0.18, 0.18, 0.2, 1), contype=0, conaffinity=0,
        )  # fmt: skip
        lever = body.add("body", name="lever", pos=self.PIVOT, euler=(0, 0, self.START_ANGLE), gravcomp=1)
        lever.add(
            "joint", name="lever", type="hinge", axis=(0, 0, 1), range=(0, 1.7), limited=True, damping=0.05,
            frictionloss=0.03, armature=0.002,
        )  # fmt: skip
        blue: dict[str, Any] = {"contype": 0, "conaffinity": 0, "rgba": (0.08, 0.2, 0.75, 1)}
        self._disc(lever, 0.022, -0.010, 0.002, mass=0.05, **blue)
        self._box(lever, (self.PEG_RADIUS / 2, 0, 0), (self.PEG_RADIUS / 2, 0.010, 0.005), mass=0.05, **blue)
        lever.add(
            "geom", name="peg", type="cylinder", pos=(self.PEG_RADIUS, 0, self.PEG_HEIGHT / 2),
            size=(0.013, self.PEG_HEIGHT / 2), mass=0.05, rgba=(0.95, 0.80, 0.1, 1),
        )  # fmt: skip
        self._mark(lever, "peg", (self.PEG_RADIUS, 0, self.PEG_HEIGHT / 2))
        self._region(
            body, "cook_region", (*self.BURNER, 0.025), (self.COOKS_WITHIN, self.COOKS_WITHIN, 0.002), on_top=True
        )
        self.states["TurnOn", ""] = JointState("lever", self.ON_ABOVE, math.inf, (1.2, 1.6))
        self.states["TurnOff", ""] = JointState("lever", -math.inf, 0.2, (0.0, 0.0))

    @classmethod
    def glow(cls, model: mujoco.MjModel, name: str) -> Glow:
        """The burner of stove ``name`` glows while it is on."""
        address = int(model.joint(f"{name}/lever").qposadr[0])
        burner = model.geom(f"{name}/burner").id
        return Glow(burner, address, cls.ON_ABOVE, (1.0, 0.12, 0.05, 1), (0.18, 0.18, 0.2, 1))


class WideStove(Stove):
    """A stove whose lever stays clear of what stands on its burner, which takes two pots; on from LIBERO's 0.5 rad."""

    ON_ABOVE = 0.5

    PEG_RADIUS, PIVOT = 0.070, (-0.095, 0.0, 0.035)
    BURNER, BURNER_RADIUS, COOKS_WITHIN = (0.055, 0.0), 0.075, 0.065
