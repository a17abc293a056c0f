"""What a basket is filled with: cans, boxes, cartons, bottles; and a book. All fit between the fingers (0.08 m)."""

from __future__ import annotations

from dm_control import mjcf

from worldenv_trl.scenes.entities.base import GHOST, Color, Grasp, Primitive
from worldenv_trl.scenes.materials import PAGES

WHITE: Color = (0.95, 0.95, 0.95, 1)


class Can(Primitive):
    """An upright can with a label around it."""

    RADIUS = 0.032
    radius, height = 0.036, 0.085
    grasp = Grasp((0.0, 0.0, 0.055), kind="round")

    def _shape(self, body: mjcf.Element, label: Color = (0.80, 0.10, 0.10, 1), band: Color = WHITE) -> None:
        top = self.height
        self._disc(body, self.RADIUS, 0.0, top, mass=0.20, rgba=(0.70, 0.71, 0.74, 1))
        self._disc(body, self.RADIUS + 0.0006, 0.008, top - 0.008, **GHOST, rgba=label)
        self._disc(body, self.RADIUS + 0.0010, 0.38 * top, 0.62 * top, **GHOST, rgba=band)
        self._mark(body, "center", (0, 0, 0))


class Packet(Primitive):
    """A box that lies flat, its long side along x, with a stripe across it.

    ``size`` is (length, depth, height).
    """

    def _shape(
        self,
        body: mjcf.Element,
        size: tuple[float, float, float] = (0.09, 0.05, 0.035),
        color: Color = WHITE,
        stripe: Color = (0.1, 0.3, 0.8, 1),
        mass: float = 0.12,
    ) -> None:
        length, depth, height = half = (size[0] / 2, size[1] / 2, size[2] / 2)
        self.radius, self.height, self.footprint = (length**2 + depth**2) ** 0.5, size[2], half[:2]
        if size[1] < 0.075:  # else it is wider than the hand opens
            self.grasp = Grasp((0.0, 0.0, 0.6 * size[2]), release=0.035)
        self._box(body, (0, 0, height), half, mass=mass, rgba=color)
        self._box(body, (0, 0, height), (0.36 * length, depth + 0.0006, height + 0.0006), **GHOST, rgba=stripe)
        self._mark(body, "center", (0, 0, 0))


class Carton(Primitive):
    """An upright drinks carton with a gable."""

    HALF = 0.030
    radius, height = 0.045, 0.098
    grasp = Grasp((0.0, 0.0, 0.062), kind="square")
    footprint = (HALF, HALF)

    def _shape(self, body: mjcf.Element, color: Color = WHITE, label: Color = (0.1, 0.35, 0.85, 1)) -> None:
        half, shoulder = self.HALF, 0.076
        self._box(body, (0, 0, shoulder / 2), (half, half, shoulder / 2), mass=0.07, rgba=color)
        self._box(body, (0, 0, 0.5 * shoulder), (half + 0.0006, half + 0.0006, 0.2 * shoulder), **GHOST, rgba=label)
        gable = {"rgba": label, "mass": 0.002}  # narrower than the box: the fingers close on that
        self._box(body, (0, 0, shoulder + 0.006), (0.75 * half, half - 0.004, 0.006), **gable)
        self._box(body, (0, 0, shoulder + 0.017), (0.25 * half, half - 0.004, 0.005), **gable)
        self._mark(body, "center", (0, 0, 0))


class Bottle(Primitive):
    """An upright bottle with a neck and a cap; ``tall`` is a wine bottle."""

    RADIUS = 0.029
    radius = 0.034

    def _shape(
        self,
        body: mjcf.Element,
        glass: Color = (0.75, 0.12, 0.08, 1),
        label: Color = WHITE,
        cap: Color = WHITE,
        tall: bool = False,
    ) -> None:
        shoulder, neck, top = (0.135, 0.185, 0.200) if tall else (0.095, 0.125, 0.142)
        self.height = top
        self.grasp = Grasp((0.0, 0.0, top - 0.024), kind="round")  # by the neck: the palm has no room for it
        self._disc(body, self.RADIUS, 0.0, shoulder, mass=0.10, rgba=glass)
        self._disc(body, self.RADIUS + 0.0006, 0.25 * shoulder, 0.75 * shoulder, **GHOST, rgba=label)
        self._disc(body, 0.62 * self.RADIUS, shoulder, 0.5 * (shoulder + neck), mass=0.01, rgba=glass)
        self._disc(body, 0.42 * self.RADIUS, 0.5 * (shoulder + neck), neck, mass=0.01, rgba=glass)
        self._disc(body, 0.50 * self.RADIUS, neck, top, mass=0.005, rgba=cap)
        self._mark(body, "center", (0, 0, 0))


class Book(Primitive):
    """A book that stands on its lower edge, cover towards y; thin enough to be gripped across the spine."""

    THICKNESS, WIDTH = 0.030, 0.090
    radius, height = 0.05, 0.130
    footprint = (WIDTH / 2, THICKNESS / 2)
    grasp = Grasp((0.0, 0.0, 0.100))

    def _shape(self, body: mjcf.Element, cover: Color = (0.10, 0.10, 0.13, 1)) -> None:
        x, y, z = self.WIDTH / 2, self.THICKNESS / 2, self.height / 2
        paper = {"rgba": (0.95, 0.92, 0.82, 1), **PAGES.of(self._root)}
        self._box(body, (0, 0, z), (x, y, z), mass=0.10, rgba=cover)
        self._box(body, (0.0015, 0, z + 0.0006), (x, y - 0.004, z), **GHOST, **paper)
        self._box(body, (0, 0, 1.4 * z), (0.6 * x, y + 0.0006, 0.012), **GHOST, rgba=(0.85, 0.7, 0.2, 1))
        self._mark(body, "center", (0, 0, 0))
