"""Cabinets, microwave, basket, caddy, racks and shelves: what things are put into or onto."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from dm_control import mjcf

from worldenv_trl.scenes.entities.base import GHOST, Color, JointState, Primitive
from worldenv_trl.scenes.materials import WICKER

_WOOD: Color = (0.50, 0.30, 0.16, 1)


class Cabinet(Primitive):
    """Three drawers that slide towards +y; joints ``top``, ``middle``, ``bottom`` open towards negative values.

    The range and the thresholds are those of LIBERO's wooden cabinet: open below -0.14 m.
    """

    OPEN_BELOW = -0.14
    HANDLE_HALF_WIDTH, HANDLE_RISE = 0.034, 0.007  # half the bar's length; its height over the drawer's middle
    HANDLE_REACH: Mapping[str, float] = MappingProxyType(dict.fromkeys(("bottom", "middle", "top"), 0.060))
    """How far each bar stands out from its front."""
    DEPTH, WIDTH, TOP = 0.10, 0.085, 0.168
    LEVELS: tuple[tuple[str, float], ...] = (("bottom", 0.03), ("middle", 0.085), ("top", 0.14))
    TRAVEL = (-0.16, 0.0)
    BAR = 0.006  # half the bar's thickness
    SIDE_TOP = 0.020  # upper edge of a drawer's sides, over its middle
    REGION_AHEAD = 0.0  # of a drawer's middle, towards its front
    HOLLOW = False  # whether the drawers hold things; walls that collide cost time
    radius, height = 0.15, TOP + 0.004
    footprint = (WIDTH, DEPTH)

    def _shape(
        self,
        body: mjcf.Element,
        wood: Color = _WOOD,
        inside: Color = (0.86, 0.68, 0.42, 1),
        front: Color = (0.93, 0.78, 0.52, 1),
    ) -> None:
        back, top, wooden = self.DEPTH, self.TOP, {"rgba": wood}
        self._box(body, (0, -back + 0.004, top / 2), (self.WIDTH, 0.004, top / 2), **wooden)
        for side in (-1, 1):
            self._box(body, (side * (self.WIDTH - 0.004), 0, top / 2), (0.004, back, top / 2), **wooden)
        self._box(body, (0, 0, top), (self.WIDTH, back, 0.004), **wooden)
        self._region(body, "top_side", (0, 0, top + 0.004), (self.WIDTH, back, 0.002), on_top=True)
        for name, level in self.LEVELS:
            self._drawer(body, name, level, inside, front)

    def _drawer(self, body: mjcf.Element, name: str, level: float, inside: Color, front: Color) -> None:
        back, inner, reach = self.DEPTH, self.WIDTH - 0.010, self.HANDLE_REACH[name]
        drawer = body.add("body", name=name, pos=(0, 0, level), gravcomp=1)
        drawer.add(
            "joint", name=name, type="slide", axis=(0, -1, 0), range=self.TRAVEL, limited=True, damping=8.0,
            frictionloss=0.8, armature=0.05,
        )  # fmt: skip
        box = {"rgba": inside} if self.HOLLOW else {"rgba": inside, "contype": 0, "conaffinity": 0}
        self._box(drawer, (0, 0, -0.018), (inner, back - 0.006, 0.003), mass=0.15, **box)
        wall = (self.SIDE_TOP + 0.020) / 2
        for side in (-1, 1):
            at = (side * (inner - 0.003), 0, self.SIDE_TOP - wall)
            self._box(drawer, at, (0.003, back - 0.006, wall), mass=0.05, **box)
        if self.HOLLOW:
            self._box(drawer, (0, -back + 0.012, 0), (inner, 0.003, 0.020), mass=0.05, **box)
        self._box(drawer, (0, back, 0), (inner + 0.006, 0.004, 0.025), mass=0.1, rgba=front)
        metal = {
            "rgba": (0.80, 0.10, 0.12, 1) if name == "top" else (0.35, 0.35, 0.38, 1),
            "friction": (1.5, 0.05, 0.001),
        }
        for side in (-1, 1):
            post = (side * (self.HANDLE_HALF_WIDTH - 0.004), back + 0.5 * reach, self.HANDLE_RISE)
            self._box(drawer, post, (0.004, 0.5 * reach - 0.002, 0.005), mass=0.01, **metal)
        bar = (0, back + reach, self.HANDLE_RISE)
        self._box(drawer, bar, (self.HANDLE_HALF_WIDTH, self.BAR, 0.007), mass=0.03, **metal)
        self._mark(drawer, f"{name}_handle", bar)
        self._jut(drawer, f"{name}_front", (0, back + 0.5 * reach, 0), (self.WIDTH, 0.5 * reach + self.BAR, 0.025))
        ahead = self.REGION_AHEAD
        self._region(drawer, f"{name}_region", (0, ahead, 0.01), (inner - 0.008, back - 0.016 - ahead, 0.028))
        self.states["Open", f"{name}_region"] = JointState(name, -math.inf, self.OPEN_BELOW, (-0.16, -0.14))
        closed = self.TRAVEL[1] - 0.005 if self.TRAVEL[1] <= 0 else 1e-6  # LIBERO: past 0
        self.states["Close", f"{name}_region"] = JointState(name, closed, math.inf, (max(closed, 0.0), self.TRAVEL[1]))


class DeepCabinet(Cabinet):
    """A cabinet whose drawers hold a bowl; a drawer is closed past 0 (LIBERO), a centimetre before its stop.

    The lower a handle, the further it stands out, so that a hand that points down reaches every one of them.
    """

    TOP = 0.202
    LEVELS = (("bottom", 0.030), ("middle", 0.094), ("top", 0.158))
    HANDLE_RISE, BAR = 0.015, 0.004
    HANDLE_REACH = MappingProxyType({"bottom": 0.110, "middle": 0.085, "top": 0.036})
    TRAVEL = (-0.16, 0.01)
    REGION_AHEAD = 0.015  # an open drawer's middle is still half under the top
    SIDE_TOP = 0.0  # fingers reach down on both sides of a bowl's rim
    HOLLOW = True
    height = TOP + 0.004


class Microwave(Primitive):
    """An oven whose door, at -y, swings open about its left edge; joint ``door`` opens towards negative values."""

    HALF = (0.13, 0.11, 0.085)
    OPEN_BELOW, CLOSED_ABOVE = -1.3, -0.005
    radius, height = 0.19, 0.17
    footprint = HALF[:2]

    def _shape(self, body: mjcf.Element) -> None:
        x, y, z = self.HALF
        shell = {"rgba": (0.86, 0.87, 0.89, 1)}
        for low in (0.006, 2 * z - 0.006):
            self._box(body, (0, 0, low), (x, y, 0.006), **shell)
        self._box(body, (0, y - 0.006, z), (x, 0.006, z), **shell)
        self._box(body, (-x + 0.006, 0, z), (0.006, y, z), **shell)
        self._box(body, (x - 0.030, 0, z), (0.030, y, z), **shell)  # the controls
        self._box(body, (x - 0.030, -y, 1.3 * z), (0.018, 0.001, 0.012), **GHOST, rgba=(0.1, 0.7, 0.3, 1))
        opening = x - 0.033  # half of what the door covers
        door = body.add("body", name="door", pos=(-x, -y - 0.006, z), gravcomp=1)
        door.add(
            "joint", name="door", type="hinge", axis=(0, 0, 1), range=(-2.094, 0.0), limited=True, damping=0.2,
            frictionloss=0.05, armature=0.01,
        )  # fmt: skip
        dark = {"rgba": (0.12, 0.13, 0.16, 1)}
        self._box(door, (opening, 0, 0), (opening, 0.006, z), mass=0.3, **dark)
        self._box(door, (opening, -0.001, 0), (0.7 * opening, 0.006, 0.6 * z), **GHOST, rgba=(0.30, 0.36, 0.45, 1))
        grip = (1.85 * opening, -0.034, 0)
        for end in (-1, 1):
            self._box(door, (grip[0], -0.018, end * 0.045), (0.005, 0.014, 0.005), mass=0.01, **dark)
        self._box(door, grip, (0.006, 0.006, 0.052), mass=0.03, rgba=(0.80, 0.10, 0.12, 1))
        self._mark(door, "door_handle", grip)
        self._jut(door, "door_leaf", (opening, -0.014, 0), (opening, 0.026, z))
        self._region(body, "heating_region", (-0.03, 0, z), (0.090, 0.095, 0.072))
        self._region(body, "top_side", (0, 0, 2 * z), (x, y, 0.002), on_top=True)
        self.states["Open", ""] = JointState("door", -math.inf, self.OPEN_BELOW, (-2.094, -1.3))
        self.states["Close", ""] = JointState("door", self.CLOSED_ABOVE, math.inf, (-0.005, 0.0))


class Basket(Primitive):
    """An open basket, 0.26 x 0.22 m, 0.09 m high, wide enough to let things fall in."""

    HALF = (0.13, 0.11)
    radius, height = 0.16, 0.09
    footprint = HALF
    surface = 0.008

    def _shape(self, body: mjcf.Element) -> None:
        x, y = self.HALF
        weave, floor = {"rgba": (0.80, 0.58, 0.31, 1), **WICKER.of(self._root)}, {"rgba": (0.52, 0.36, 0.20, 1)}
        self._box(body, (0, 0, 0.004), (x, y, 0.004), mass=0.6, **floor)
        for side in (-1, 1):
            self._box(body, (side * (x - 0.004), 0, 0.045), (0.004, y, 0.045), mass=0.1, **weave)
            self._box(body, (0, side * (y - 0.004), 0.045), (x, 0.004, 0.045), mass=0.1, **weave)
        self._region(body, "contain_region", (0, 0, 0.055), (x - 0.012, y - 0.012, 0.050))


class Caddy(Primitive):
    """A desk organiser: a deep compartment at the back, two in the middle, a low one in front (+x)."""

    radius, height = 0.15, 0.12
    footprint = (0.094, 0.124)

    def _shape(self, body: mjcf.Element) -> None:
        wood, x, y = {"rgba": (0.80, 0.62, 0.40, 1)}, 0.09, 0.12
        self._box(body, (0, 0, 0.004), (x, y, 0.004), **wood)
        for at, high in ((-x, 0.06), (-0.025, 0.05), (0.045, 0.035), (x, 0.025)):
            self._box(body, (at, 0, high), (0.004, y, high), **wood)
        for side in (-1, 1):
            self._box(body, (0, side * y, 0.04), (x, 0.004, 0.04), **wood)
        self._box(body, (0.010, 0, 0.03), (0.031, 0.004, 0.03), **wood)
        self._region(body, "back_contain_region", (-0.0575, 0, 0.065), (0.028, y - 0.008, 0.057))
        self._region(body, "left_contain_region", (0.010, -0.062, 0.050), (0.029, 0.050, 0.042))
        self._region(body, "right_contain_region", (0.010, 0.062, 0.050), (0.029, 0.050, 0.042))
        self._region(body, "front_contain_region", (0.0675, 0, 0.035), (0.018, y - 0.008, 0.027))


class Rack(Primitive):
    """A wine rack: a slatted deck on four posts, with a low rim."""

    radius, height = 0.13, 0.085
    footprint = (0.079, 0.105)

    def _shape(self, body: mjcf.Element) -> None:
        x, y, deck = 0.075, 0.105, 0.062
        wood = {"rgba": (0.36, 0.20, 0.11, 1)}
        for side_x in (-1, 1):
            for side_y in (-1, 1):
                post = (side_x * (x - 0.008), side_y * (y - 0.008), deck / 2)
                self._box(body, post, (0.008, 0.008, deck / 2), **wood)
        for at in (-0.055, -0.018, 0.018, 0.055):
            self._box(body, (at, 0, deck), (0.013, y, 0.006), **wood)
        for side in (-1, 1):
            self._box(body, (side * x, 0, deck + 0.010), (0.004, y, 0.012), **wood)
        self._region(body, "top_region", (0, 0, deck + 0.006), (x - 0.005, y - 0.005, 0.004), on_top=True)


class Shelf(Primitive):
    """Two boards between two sides, open to both ends of y."""

    radius, height = 0.16, 0.20
    footprint = (0.125, 0.09)

    def _shape(self, body: mjcf.Element) -> None:
        x, y, wood = 0.12, 0.09, {"rgba": (0.66, 0.47, 0.27, 1)}
        for side in (-1, 1):
            self._box(body, (side * x, 0, 0.098), (0.005, y, 0.098), **wood)
        for level in (0.006, 0.194):
            self._box(body, (0, 0, level), (x, y, 0.006), **wood)
        self._region(body, "bottom_region", (0, 0, 0.10), (x - 0.010, y, 0.085))
        self._region(body, "top_side", (0, 0, 0.200), (x, y, 0.002), on_top=True)
