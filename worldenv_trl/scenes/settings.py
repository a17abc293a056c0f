"""Where a task file plays: table or floor, kitchen, living room or study."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import mujoco

from worldenv_trl.scenes import panda
from worldenv_trl.scenes.arena import AGENTVIEW, TabletopArena
from worldenv_trl.scenes.bddl import Problem
from worldenv_trl.scenes.camera import Camera, look_at
from worldenv_trl.scenes.entities import Primitive, make_entity
from worldenv_trl.scenes.entities.base import Color
from worldenv_trl.scenes.entities.registry import WORKSPACES
from worldenv_trl.scenes.materials import BOARDS, GRAIN, PARQUET, PLASTER, TILES, WALL_TILES, WALLPAPER, Material

__all__ = ["SETTINGS", "Setting", "compile_scene", "part_of", "setting_of"]

# As quick as the time step allows, so that friction hardly creeps, and damped four times over critical, so that what is
# held by two flat pads does not jitter out of them.
CONTACT = (0.01, 4)


@dataclass(frozen=True)
class Setting:
    """Colours, materials and camera, and where the workspace's (0, 0) lies on our table.

    The robot stands at the same place in all of them; LIBERO's workspaces begin at other distances from it.
    """

    base_distance: float
    table: Color
    wall: Color
    camera: Camera
    table_material: Material = GRAIN
    wall_material: Material = PLASTER

    @property
    def origin(self) -> tuple[float, float]:
        return panda.BASE_POSITION[0] + self.base_distance, 0.0


_WIDE = look_at("agentview", (0.86, 0.0, 0.80), (-0.09, 0.0, 0.05), 36.0)
_TABLETOP = Setting(0.66, (0.72, 0.70, 0.66, 1), (0.45, 0.52, 0.50, 1), _WIDE)
_KITCHEN = Setting(0.66, (0.62, 0.64, 0.60, 1), (0.78, 0.70, 0.48, 1), _WIDE, TILES, WALL_TILES)
_LIVING_ROOM = Setting(0.51, (0.55, 0.42, 0.32, 1), (0.62, 0.60, 0.64, 1), _WIDE, BOARDS, WALLPAPER)
_STUDY = Setting(0.55, (0.66, 0.58, 0.48, 1), (0.40, 0.44, 0.55, 1), _WIDE, GRAIN, PLASTER)
_FLOOR = Setting(0.60, (0.60, 0.62, 0.64, 1), (0.50, 0.46, 0.42, 1), _WIDE, PARQUET, PLASTER)

_BENCH = Setting(-panda.BASE_POSITION[0], (0.72, 0.70, 0.66, 1), (0.45, 0.52, 0.50, 1), AGENTVIEW)

SETTINGS: Mapping[str, Setting] = MappingProxyType(
    {
        "bench": _BENCH,
        "tabletop": _TABLETOP,
        "kitchen": _KITCHEN,
        "living_room": _LIVING_ROOM,
        "study": _STUDY,
        "floor": _FLOOR,
        "libero_tabletop_manipulation": _TABLETOP,
        "libero_kitchen_tabletop_manipulation": _KITCHEN,
        "libero_living_room_tabletop_manipulation": _LIVING_ROOM,
        "libero_study_tabletop_manipulation": _STUDY,
        "libero_floor_manipulation": _FLOOR,
    }
)
"""By the class in ``(problem CLASS)``."""


def setting_of(problem: Problem) -> Setting:
    """Raises ``ValueError`` with the closest name for an unknown problem class."""
    if problem.kind not in SETTINGS:
        close = difflib.get_close_matches(problem.kind, SETTINGS, n=1, cutoff=0.4)
        hint = f"did you mean {close[0]!r}?" if close else f"known ones: {', '.join(SETTINGS)}"
        raise ValueError(
            f"{problem.source}: unknown class {problem.kind!r} in (problem ...), where the task plays: {hint}"
        )
    return SETTINGS[problem.kind]


def compile_scene(problem: Problem) -> tuple[dict[str, Primitive], mujoco.MjModel]:
    """The things of a task file by name, and the scene they make up.

    Raises:
        ValueError: for an unknown problem class or category, naming the file.
    """
    setting = setting_of(problem)
    arena = TabletopArena(
        (setting.camera,),
        table=setting.table,
        wall=setting.wall,
        table_material=setting.table_material,
        wall_material=setting.wall_material,
    )
    entities: dict[str, Primitive] = {}
    for named, add in ((problem.fixtures, arena.add_fixture), (problem.objects, arena.add_object)):
        for name, category in named.items():
            if category in WORKSPACES:
                continue
            try:
                entities[name] = make_entity(category, name)
            except ValueError as error:
                raise ValueError(f"{problem.source}: {error}") from None
            entities[name].mjcf_model.default.geom.solref = CONTACT
            add(entities[name])
    for side in ("left", "right"):
        arena.root.find("geom", f"panda/{side}_pad").solref = CONTACT
    return entities, mujoco.MjModel.from_xml_string(arena.root.to_xml_string(), arena.root.get_assets())


def part_of(problem: Problem, entities: Mapping[str, Primitive], name: str) -> tuple[str, str]:
    """The entity, or workspace, and its region (or "") that ``name`` means.

    Raises:
        ValueError: if the entity has no such region, naming the file and the regions it has.
    """
    if name in entities:
        return name, ""
    if name not in problem.regions:
        raise ValueError(f"{problem.source}: {name!r} is neither a thing nor a region here")
    target = problem.regions[name].target
    part = name.removeprefix(f"{target}_")
    if target in entities and part not in entities[target].regions:
        known = ", ".join(entities[target].regions) or "none"
        raise ValueError(f"{problem.source}: {target} has no region {part!r}; it has {known}")
    return target, part
