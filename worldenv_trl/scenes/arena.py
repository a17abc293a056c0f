"""Table, floor, lights, cameras and robot: what every tabletop scene shares."""

from __future__ import annotations

from collections.abc import Sequence

from dm_control import composer, mjcf

from worldenv_trl.robot import WRIST, Camera, look_at
from worldenv_trl.robot.panda import BASE_POSITION
from worldenv_trl.scenes.entities.base import Color
from worldenv_trl.scenes.materials import GRAIN, PLASTER, Material
from worldenv_trl.scenes.panda import TIMESTEP, USERDATA, Panda

AGENTVIEW = look_at("agentview", (0.78, 0.0, 0.60), (-0.03, 0.0, 0.105), 31.0)


class TabletopArena:
    """A table whose top is z = 0 with the robot at its edge; objects and fixtures are attached to it.

    Fixtures are mocap bodies: they never move, and their place belongs to the integration state, so an initial state
    restores it (LIBERO's initial states do not).
    """

    def __init__(
        self,
        cameras: tuple[Camera, ...] = (AGENTVIEW, WRIST),
        *,
        table: Color = (0.72, 0.70, 0.66, 1),
        wall: Color = (0.45, 0.52, 0.50, 1),
        table_material: Material = GRAIN,
        wall_material: Material = PLASTER,
    ) -> None:
        self.root = root = mjcf.RootElement(model="scene")
        root.compiler.angle = "radian"
        root.option.set_attributes(timestep=TIMESTEP, integrator="implicitfast", cone="elliptic", impratio=10)
        root.option.flag.autoreset = "disable"  # a state that blows up must be seen, not silently replaced
        root.size.nuserdata = USERDATA
        # Round shapes cost by their facets, and shadows cost most of all (software GL).
        root.visual.quality.set_attributes(numslices=10, numstacks=6, numquads=1, shadowsize=0)
        root.visual.map.znear = 0.02
        root.statistic.extent = 1.0  # the unit of znear: the wrist camera looks from 10 cm
        root.visual.headlight.set_attributes(ambient=(0.45, 0.45, 0.45), diffuse=(0.45, 0.45, 0.45), specular=(0, 0, 0))
        root.worldbody.add(
            "light",
            pos=(0.4, 0.6, 1.6),
            dir=(-0.2, -0.35, -0.9),
            directional=True,
            castshadow=False,
            diffuse=(0.35, 0.35, 0.35),
        )
        root.worldbody.add(
            "geom", name="table", type="box", pos=(0, 0, -0.02), size=(0.5, 0.7, 0.02), rgba=table,
            friction=(1.0, 0.01, 0.0005), condim=4, **table_material.of(root),
        )  # fmt: skip
        root.worldbody.add(
            "geom",
            name="wall",
            type="box",
            pos=(-1.2, 0, 0),
            xyaxes=(0, 1, 0, 0, 0, 1),  # its z axis, along which the pattern is projected, points at the robot
            size=(3, 3, 0.02),
            rgba=wall,
            contype=0,
            conaffinity=0,
            **wall_material.of(root),
        )
        for camera in cameras:
            if camera.mount == "world":
                root.worldbody.add(
                    "camera", name=camera.name, pos=camera.position, xyaxes=camera.axes, fovy=camera.fovy
                )
        on_tool = tuple(camera for camera in cameras if camera.mount == "tool")
        self.attach(Panda("panda", on_tool), pos=BASE_POSITION)

    def attach(self, entity: composer.Entity, pos: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Fixes an entity to the world."""
        self.root.worldbody.add("site", pos=pos, size=(0.001,), rgba=(0, 0, 0, 0)).attach(entity.mjcf_model)

    def add_object(self, entity: composer.Entity) -> None:
        """Adds an entity that moves freely; its joint is named like the entity."""
        frame = self.root.attach(entity.mjcf_model)
        frame.add("freejoint")

    def add_fixture(self, entity: composer.Entity) -> None:
        """Adds an entity that is placed by the initial state and then never moves."""
        frame = self.root.attach(entity.mjcf_model)
        frame.mocap = True
