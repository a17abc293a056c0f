"""What all objects and fixtures share: solid primitives, named regions, joint states. Metres, radians, kilograms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dm_control import composer, mjcf

Color = tuple[float, float, float, float]

SOLID = {"condim": 4, "friction": (1.0, 0.01, 0.0005), "solref": (0.01, 1), "solimp": (0.95, 0.99, 0.001)}
GHOST: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0.0}
"""Drawn only."""
INVISIBLE: dict[str, Any] = {"rgba": (0, 0, 0, 0), "group": 4}


@dataclass(frozen=True)
class Region:
    """A box inside or on top of an entity; it moves with ``body`` (an own body's name; empty is the root).

    ``on_top`` regions hold what stands on them, the others what is inside (LIBERO's ``top_side`` and ``top_region``).
    """

    name: str
    center: tuple[float, float, float]
    half_size: tuple[float, float, float]
    body: str = ""
    on_top: bool = False


@dataclass(frozen=True)
class Grasp:
    """Where the hand, pointing down with its fingers along the thing's y axis, closes around it.

    ``offset`` is from the thing's origin to the point between the fingertips; ``release`` is how far above its place
    the thing is let go. ``kind``: ``across`` (the fingers stay along y), ``square`` (or along x), ``round`` (any way)
    or ``rim`` (any point of a circle with the offset's radius, one finger inside and one outside).
    """

    offset: tuple[float, float, float]
    release: float = 0.0
    kind: str = "across"


@dataclass(frozen=True)
class JointState:
    """A named state of a joint: the interval of positions in which it holds, and the one that initial states draw."""

    joint: str
    low: float
    high: float
    start: tuple[float, float]


class Primitive(composer.Entity):
    """An entity whose origin is where it rests on what is below it; parts are added by ``_shape``.

    Attributes:
        radius: horizontal radius that is kept free of other things when an initial state is drawn.
        footprint: half sizes along x and y that are kept free instead, of things that are not round.
        height: of its highest point at rest.
        surface: height of what stands on it.
        grasp: how it is picked up; None for what is not.
        regions: by name, see :class:`Region`; each is a box site of that name.
        juts: what else stands in the way of a hand, and may move: half sizes by the name of a box site.
        states: ``(predicate, part)`` to :class:`JointState`; the part is a region's name, or empty for the whole.
    """

    radius: float = 0.05
    footprint: tuple[float, float] | None = None
    height: float = 0.05
    grasp: Grasp | None = None

    @property
    def surface(self) -> float:
        return self.height

    def _build(self, name: str, **shape: object) -> None:
        self._root = mjcf.RootElement(model=name)
        self._root.compiler.angle = "radian"
        self._root.default.geom.set_attributes(**SOLID)
        self.regions: dict[str, Region] = {}
        self.juts: dict[str, tuple[float, float, float]] = {}
        self.states: dict[tuple[str, str], JointState] = {}
        self._shape(self._root.worldbody, **shape)

    def _shape(self, body: mjcf.Element) -> None:
        raise AssertionError("every primitive has a shape")

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._root

    # ------------------------------------------------------------------------------------------------- parts

    def _box(
        self, body: mjcf.Element, center: Sequence[float], half_size: Sequence[float], **options: Any
    ) -> mjcf.Element:
        return body.add("geom", type="box", pos=tuple(center), size=tuple(half_size), **options)

    def _disc(
        self,
        body: mjcf.Element,
        radius: float,
        low: float,
        high: float,
        *,
        at: Sequence[float] = (0.0, 0.0),
        **options: Any,
    ) -> mjcf.Element:
        """An upright cylinder between two heights."""
        center = (*at, (low + high) / 2)
        return body.add("geom", type="cylinder", pos=center, size=(radius, (high - low) / 2), **options)

    def _ring(
        self,
        body: mjcf.Element,
        foot: float,
        rim: float,
        low: float,
        high: float,
        *,
        mass: float,
        staves: int = 12,
        thickness: float = 0.003,
        **options: Any,
    ) -> None:
        """A wall around the z axis, hollow inside: flat staves of ``mass`` each, ``foot`` from the axis at ``low``, and
        ``rim`` at ``high``."""
        lean, length = math.atan2(rim - foot, high - low), math.hypot(rim - foot, high - low)
        radius, half_width = (rim + foot) / 2, max(rim, foot) * math.tan(math.pi / staves)
        for index in range(staves):
            turn = 2 * math.pi * index / staves
            quat = product(
                (math.cos(turn / 2), 0, 0, math.sin(turn / 2)), (math.cos(lean / 2), 0, math.sin(lean / 2), 0)
            )
            center = (radius * math.cos(turn), radius * math.sin(turn), (low + high) / 2)
            self._box(body, center, (thickness, half_width, length / 2), quat=quat, mass=mass, **options)

    def _region(
        self,
        body: mjcf.Element,
        name: str,
        center: tuple[float, float, float],
        half_size: tuple[float, float, float],
        *,
        on_top: bool = False,
    ) -> None:
        body.add("site", name=name, type="box", pos=tuple(center), size=tuple(half_size), **INVISIBLE)
        owner = "" if body is self._root.worldbody else body.name
        self.regions[name] = Region(name, center, half_size, owner, on_top)

    def _jut(
        self, body: mjcf.Element, name: str, center: Sequence[float], half_size: tuple[float, float, float]
    ) -> None:
        body.add("site", name=name, type="box", pos=tuple(center), size=tuple(half_size), **INVISIBLE)
        self.juts[name] = half_size

    def _mark(self, body: mjcf.Element, name: str, position: Sequence[float]) -> None:
        """A point that others look for: a handle, a centre."""
        body.add("site", name=name, pos=tuple(position), size=(0.003,), **INVISIBLE)


def product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float, float]:
    """Hamilton product of quaternions (w, x, y, z)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
