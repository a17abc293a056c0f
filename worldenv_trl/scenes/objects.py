"""Objects and fixtures, composed of primitives. Metres; the origin of each is where it rests on the table."""

from __future__ import annotations

import math

from dm_control import composer, mjcf

_SOLID = {"condim": 4, "friction": (1.0, 0.01, 0.0005), "solref": (0.01, 1), "solimp": (0.95, 0.99, 0.001)}


class _Primitive(composer.Entity):
    """An entity whose parts are added by ``_shape``; drawn and colliding unless said otherwise."""

    def _build(self, name: str) -> None:
        self._root = mjcf.RootElement(model=name)
        self._root.compiler.angle = "radian"
        self._root.default.geom.set_attributes(**_SOLID)
        self._shape(self._root.worldbody)

    def _shape(self, body: mjcf.Element) -> None:
        raise AssertionError("every primitive has a shape")

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._root


class Bowl(_Primitive):
    """An open bowl, graspable anywhere on its rim: twelve flat staves on a disc. 0.12 m across, 0.05 m high.

    It weighs 0.1 kg: twice that sags in the grip by 20 degrees and springs away when it is set down.
    """

    RIM_RADIUS = 0.058
    FOOT_RADIUS = 0.054
    HEIGHT = 0.05

    def _shape(self, body: mjcf.Element) -> None:
        foot, staves = self.FOOT_RADIUS, 12
        # Green is nobody else's: a dark bowl runs into the dark hand that holds it.
        outside, inside = {"rgba": (0.13, 0.62, 0.30, 1)}, {"rgba": (0.05, 0.22, 0.12, 1)}
        body.add("geom", name="foot", type="cylinder", pos=(0, 0, 0.004), size=(foot, 0.004), mass=0.03, **inside)
        lean = math.atan2(self.RIM_RADIUS - foot, self.HEIGHT)
        length = math.hypot(self.RIM_RADIUS - foot, self.HEIGHT)
        radius = (self.RIM_RADIUS + foot) / 2
        for index in range(staves):
            turn = 2 * math.pi * index / staves
            half_width = self.RIM_RADIUS * math.tan(math.pi / staves)
            quat = _product(
                (math.cos(turn / 2), 0, 0, math.sin(turn / 2)), (math.cos(lean / 2), 0, math.sin(lean / 2), 0)
            )
            body.add(
                "geom", type="box", pos=(radius * math.cos(turn), radius * math.sin(turn), self.HEIGHT / 2),
                quat=quat, size=(0.003, half_width, length / 2), mass=0.006, **outside,
            )  # fmt: skip
        body.add("site", name="center", pos=(0, 0, 0), size=(0.003,), rgba=(0, 0, 0, 0))


class Plate(_Primitive):
    """A round plate, 0.18 m across: a white rim and a blue middle, so that what covers it is seen."""

    TOP = 0.012

    def _shape(self, body: mjcf.Element) -> None:
        body.add("geom", type="cylinder", pos=(0, 0, 0.006), size=(0.09, 0.006), mass=0.3, rgba=(0.95, 0.95, 0.97, 1))
        body.add(
            "geom", type="cylinder", pos=(0, 0, 0.0065), size=(0.062, 0.006), mass=0, contype=0, conaffinity=0,
            rgba=(0.15, 0.35, 0.85, 1),
        )  # fmt: skip
        body.add("site", name="center", pos=(0, 0, 0), size=(0.003,), rgba=(0, 0, 0, 0))


class Cabinet(_Primitive):
    """Three drawers that slide towards +y; joints ``top``, ``middle``, ``bottom`` open towards negative values.

    The range and the thresholds are those of LIBERO's wooden cabinet: open below -0.14 m.
    """

    OPEN_BELOW = -0.14
    HANDLE_HALF_WIDTH, HANDLE_REACH = 0.034, 0.060  # half the bar's length; how far it stands out from the front
    DEPTH, WIDTH, LEVELS = 0.10, 0.085, (("bottom", 0.03), ("middle", 0.085), ("top", 0.14))

    def _shape(self, body: mjcf.Element) -> None:
        wood = {"rgba": (0.50, 0.30, 0.16, 1)}
        back, top = self.DEPTH, 0.168
        body.add("geom", type="box", pos=(0, -back + 0.004, top / 2), size=(self.WIDTH, 0.004, top / 2), **wood)
        for side in (-1, 1):
            body.add(
                "geom", type="box", pos=(side * (self.WIDTH - 0.004), 0, top / 2), size=(0.004, back, top / 2), **wood
            )
        body.add("geom", type="box", pos=(0, 0, top), size=(self.WIDTH, back, 0.004), **wood)
        for name, height in self.LEVELS:
            drawer = body.add("body", name=name, pos=(0, 0, height), gravcomp=1)
            drawer.add(
                "joint", name=name, type="slide", axis=(0, -1, 0), range=(-0.16, 0.0), limited=True, damping=8.0,
                frictionloss=0.8, armature=0.05,
            )  # fmt: skip
            box = {"rgba": (0.86, 0.68, 0.42, 1), "contype": 0, "conaffinity": 0}
            inner = self.WIDTH - 0.010
            drawer.add("geom", type="box", pos=(0, 0, -0.018), size=(inner, back - 0.006, 0.003), mass=0.15, **box)
            for side in (-1, 1):
                drawer.add(
                    "geom",
                    type="box",
                    pos=(side * (inner - 0.003), 0, 0),
                    size=(0.003, back - 0.006, 0.020),
                    mass=0.05,
                    **box,
                )
            drawer.add(
                "geom",
                type="box",
                pos=(0, back, 0),
                size=(inner + 0.006, 0.004, 0.025),
                mass=0.1,
                rgba=(0.93, 0.78, 0.52, 1),
            )
            metal = {
                "rgba": (0.80, 0.10, 0.12, 1) if name == "top" else (0.35, 0.35, 0.38, 1),
                "friction": (1.5, 0.05, 0.001),
            }
            for side in (-1, 1):
                drawer.add(
                    "geom",
                    type="box",
                    pos=(side * (self.HANDLE_HALF_WIDTH - 0.004), back + 0.5 * self.HANDLE_REACH, 0.007),
                    size=(0.004, 0.5 * self.HANDLE_REACH - 0.002, 0.005),
                    mass=0.01,
                    **metal,
                )
            drawer.add(
                "geom",
                type="box",
                pos=(0, back + self.HANDLE_REACH, 0.007),
                size=(self.HANDLE_HALF_WIDTH, 0.006, 0.007),
                mass=0.03,
                **metal,
            )
            drawer.add(
                "site",
                name=f"{name}_handle",
                pos=(0, back + self.HANDLE_REACH, 0.007),
                size=(0.003,),
                rgba=(0, 0, 0, 0),
            )


class Stove(_Primitive):
    """A flat stove with one burner and a lever; joint ``lever`` turns from 0 (off) to 1.7 rad.

    The burner glows when on: see ``Task.paint``.
    """

    ON_ABOVE = 1.05  # sixty degrees
    PEG_RADIUS = 0.085  # lever axis to the peg that is pushed
    PIVOT = (-0.045, 0.0, 0.035)
    PEG_HEIGHT = 0.05
    START_ANGLE = -math.pi / 2  # direction of the lever (from +x) when off

    def _shape(self, body: mjcf.Element) -> None:
        body.add("geom", type="box", pos=(0, 0, 0.0125), size=(0.14, 0.12, 0.0125), rgba=(0.78, 0.80, 0.83, 1))
        body.add(
            "geom", name="burner", type="cylinder", pos=(0.075, 0, 0.0275), size=(0.055, 0.003),
            rgba=(0.18, 0.18, 0.2, 1), contype=0, conaffinity=0,
        )  # fmt: skip
        lever = body.add("body", name="lever", pos=self.PIVOT, euler=(0, 0, self.START_ANGLE), gravcomp=1)
        lever.add(
            "joint", name="lever", type="hinge", axis=(0, 0, 1), range=(0, 1.7), limited=True, damping=0.05,
            frictionloss=0.03, armature=0.002,
        )  # fmt: skip
        black = {"contype": 0, "conaffinity": 0, "rgba": (0.08, 0.2, 0.75, 1)}
        lever.add("geom", type="cylinder", pos=(0, 0, -0.004), size=(0.022, 0.006), mass=0.05, **black)
        lever.add(
            "geom",
            type="box",
            pos=(self.PEG_RADIUS / 2, 0, 0),
            size=(self.PEG_RADIUS / 2, 0.010, 0.005),
            mass=0.05,
            **black,
        )
        lever.add(
            "geom", name="peg", type="cylinder", pos=(self.PEG_RADIUS, 0, self.PEG_HEIGHT / 2),
            size=(0.013, self.PEG_HEIGHT / 2), mass=0.05, rgba=(0.95, 0.80, 0.1, 1),
        )  # fmt: skip
        lever.add("site", name="peg", pos=(self.PEG_RADIUS, 0, self.PEG_HEIGHT / 2), size=(0.003,), rgba=(0, 0, 0, 0))


def _product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
    """Hamilton product of quaternions (w, x, y, z)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
