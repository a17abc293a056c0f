"""Bowls, plates, ramekins and mugs."""

from __future__ import annotations

from dm_control import mjcf

from worldenv_trl.scenes.entities.base import GHOST, Color, Grasp, Primitive


class Bowl(Primitive):
    """An open bowl, graspable anywhere on its rim: twelve flat staves on a disc. 0.12 m across, 0.05 m high.

    It weighs 0.1 kg: twice that sags in the grip by 20 degrees and springs away when it is set down.
    """

    RIM_RADIUS = 0.058
    FOOT_RADIUS = 0.054
    HEIGHT = 0.05
    radius, height = 0.065, HEIGHT
    surface = 0.008

    # Green is nobody else's: a dark bowl runs into the dark hand that holds it.
    def _shape(
        self,
        body: mjcf.Element,
        outside: Color = (0.13, 0.62, 0.30, 1),
        inside: Color = (0.05, 0.22, 0.12, 1),
        scale: float = 1.0,
    ) -> None:
        foot, self.radius = scale * self.FOOT_RADIUS, scale * self.radius
        # Deep enough that the pads carry the bowl level.
        self.grasp = Grasp((0.0, scale * self.RIM_RADIUS - 0.004, self.HEIGHT - 0.022), kind="rim")
        self._disc(body, foot, 0.0, 0.008, name="foot", mass=0.03, rgba=inside)
        self._ring(body, foot, scale * self.RIM_RADIUS, 0.0, self.HEIGHT, mass=0.006, rgba=outside)
        self._mark(body, "center", (0, 0, 0))
        self._region(body, "contain_region", (0, 0, 0.03), (0.04, 0.04, 0.022))


class Plate(Primitive):
    """A round plate, 0.18 m across: a white rim and a blue middle, so that what covers it is seen."""

    TOP = 0.012
    radius, height = 0.095, TOP

    def _shape(
        self,
        body: mjcf.Element,
        rim: Color = (0.95, 0.95, 0.97, 1),
        middle: Color = (0.15, 0.35, 0.85, 1),
        scale: float = 1.0,
    ) -> None:
        self.radius = scale * self.radius
        self._disc(body, scale * 0.09, 0.0, 0.012, mass=0.3, rgba=rim)
        self._disc(body, scale * 0.062, 0.0005, 0.0125, **GHOST, rgba=middle)
        self._mark(body, "center", (0, 0, 0))


class Ramekin(Primitive):
    """A small baking dish, 0.09 m across: stout enough to carry a bowl."""

    radius, height = 0.05, 0.042

    def _shape(self, body: mjcf.Element) -> None:
        self._disc(body, 0.045, 0.0, 0.042, mass=0.25, rgba=(0.93, 0.90, 0.82, 1))
        self._disc(body, 0.036, 0.001, 0.0425, **GHOST, rgba=(0.80, 0.45, 0.18, 1))
        self._mark(body, "center", (0, 0, 0))


class Mug(Primitive):
    """A mug, 0.066 m across, with a handle towards +x; graspable around its body."""

    RADIUS = 0.033
    radius, height = 0.05, 0.085
    grasp = Grasp((0.0, 0.0, 0.055))

    def _shape(
        self,
        body: mjcf.Element,
        outside: Color = (0.94, 0.94, 0.95, 1),
        inside: Color = (0.62, 0.63, 0.66, 1),
        band: Color | None = None,
    ) -> None:
        radius, height = self.RADIUS, self.height
        # Solid to whatever touches it: a ring of staves turns in the fingers.
        self._disc(body, radius, 0.0, height, mass=0.10, rgba=(0, 0, 0, 0), group=3)
        self._disc(body, radius - 0.003, 0.0, 0.4 * height, **GHOST, rgba=inside)
        self._ring(body, radius - 0.003, radius - 0.003, 0.0, height, rgba=outside, **GHOST)
        if band is not None:
            self._ring(body, radius - 0.0022, radius - 0.0022, 0.0, 0.5 * height, rgba=band, **GHOST)
        handle = {"rgba": outside if band is None else band, "mass": 0.005}
        for z in (0.022, 0.063):
            self._box(body, (radius + 0.010, 0, z), (0.012, 0.004, 0.004), **handle)
        self._box(body, (radius + 0.020, 0, 0.0425), (0.004, 0.004, 0.024), **handle)
        self._mark(body, "center", (0, 0, 0))
