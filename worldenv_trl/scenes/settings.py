"""Where a task file plays: table or floor, kitchen, living room or study."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import mujoco

from worldenv_trl.robot import WRIST, Camera, look_at
from worldenv_trl.robot.panda import BASE_POSITION
from worldenv_trl.scenes.arena import AGENTVIEW, TabletopArena
from worldenv_trl.scenes.bddl import Problem, Region
from worldenv_trl.scenes.entities import CATEGORIES, Primitive, make_entity
from worldenv_trl.scenes.entities.base import Color
from worldenv_trl.scenes.entities.registry import WORKSPACES
from worldenv_trl.scenes.materials import BOARDS, GRAIN, PARQUET, PLASTER, TILES, WALL_TILES, WALLPAPER, Material

__all__ = ["SETTINGS", "Setting", "compile_scene", "joint_of", "part_of", "setting_of"]

# As quick as the time step allows, so that friction hardly creeps, and damped four times over critical, so that what is
# held by two flat pads does not jitter out of them.
CONTACT = (0.01, 4)
_TAKEN = ("panda", "scene")


@dataclass(frozen=True)
class Setting:
    """The category of the workspace, where its (0, 0) lies on our table, colours, materials and camera.

    The robot stands at the same place in all of them; LIBERO's workspaces begin at other distances from it.
    """

    workspace: str
    base_distance: float
    table: Color
    wall: Color
    camera: Camera
    table_material: Material = GRAIN
    wall_material: Material = PLASTER

    @property
    def origin(self) -> tuple[float, float]:
        return BASE_POSITION[0] + self.base_distance, 0.0


_WIDE = look_at("agentview", (0.86, 0.0, 0.80), (-0.09, 0.0, 0.05), 36.0)
_TABLETOP = Setting("table", 0.66, (0.72, 0.70, 0.66, 1), (0.45, 0.52, 0.50, 1), _WIDE)
_KITCHEN = Setting("kitchen_table", 0.66, (0.62, 0.64, 0.60, 1), (0.78, 0.70, 0.48, 1), _WIDE, TILES, WALL_TILES)
_LIVING_ROOM = Setting(
    "living_room_table", 0.51, (0.55, 0.42, 0.32, 1), (0.62, 0.60, 0.64, 1), _WIDE, BOARDS, WALLPAPER
)
_STUDY = Setting("study_table", 0.55, (0.66, 0.58, 0.48, 1), (0.40, 0.44, 0.55, 1), _WIDE, GRAIN, PLASTER)
_FLOOR = Setting("floor", 0.60, (0.60, 0.62, 0.64, 1), (0.50, 0.46, 0.42, 1), _WIDE, PARQUET, PLASTER)

_BENCH = Setting("table", -BASE_POSITION[0], (0.72, 0.70, 0.66, 1), (0.45, 0.52, 0.50, 1), AGENTVIEW)

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
        raise problem.error(
            "problem", problem.kind, message=f"unknown class in (problem ...), which says where the task plays: {hint}"
        )
    return SETTINGS[problem.kind]


def compile_scene(
    problem: Problem, cameras: tuple[Camera, ...] | None = None
) -> tuple[dict[str, Primitive], mujoco.MjModel]:
    """The things of a task file by name, and the scene they make up, seen by ``cameras`` (its setting's, and the
    wrist's, by default).

    Raises:
        BDDLError: for an unknown problem class or category, a workspace of another class, a fixture among the objects
            or an object among the fixtures, or a region off the table, naming file and line.
    """
    setting = setting_of(problem)
    arena = TabletopArena(
        (setting.camera, WRIST) if cameras is None else cameras,
        table=setting.table,
        wall=setting.wall,
        table_material=setting.table_material,
        wall_material=setting.wall_material,
    )
    entities: dict[str, Primitive] = {}
    for named, add in ((problem.fixtures, arena.add_fixture), (problem.objects, arena.add_object)):
        for name, category in named.items():
            _check_instance(problem, name, category, fixture=named is problem.fixtures)
            if category in WORKSPACES:
                _check_workspace(problem, name, category)
                continue
            try:
                entities[name] = make_entity(category, name)
            except ValueError as error:
                raise problem.error("thing", name, message=str(error)) from None
            entities[name].mjcf_model.default.geom.solref = CONTACT
            add(entities[name])
    for side in ("left", "right"):
        arena.root.find("geom", f"panda/{side}_pad").solref = CONTACT
    model = mujoco.MjModel.from_xml_string(arena.root.to_xml_string(), arena.root.get_assets())
    for region in problem.regions.values():
        if region.target not in entities:
            _check_region(problem, region, setting.origin, model.geom("table").size)
    return entities, model


def _check_instance(problem: Problem, name: str, category: str, *, fixture: bool) -> None:
    if name in CATEGORIES and name != category:
        message = f"a category as the name of a {category}: write a dash before it, 'name - {name}'"
        raise problem.error("thing", name, message=message)
    if name in _TAKEN:
        raise problem.error("thing", name, message=f"the scene has a part of this name already: call it {name}_1")
    if "/" in name:
        raise problem.error("thing", name, message="a name may not hold a slash")
    stands = category in WORKSPACES or (category in CATEGORIES and CATEGORIES[category].stands)
    if (category in WORKSPACES or category in CATEGORIES) and stands != fixture:
        here, there = (":fixtures", ":objects") if fixture else (":objects", ":fixtures")
        why = "stands still" if stands else "can be moved"
        raise problem.error("thing", name, message=f"a {category} {why}: declare it under {there}, not {here}")


def _check_workspace(problem: Problem, name: str, category: str) -> None:
    """Regions are measured from the middle of the class's own workspace: in another they would mean other places."""
    own = setting_of(problem).workspace
    if category != own:
        kinds = [kind for kind, setting in SETTINGS.items() if setting.workspace == category]
        message = (
            f"the workspace is a {category}, but (problem {problem.kind}) plays on a {own}: write '{name} - {own}', "
            f"or another class: {', '.join(kinds)}"
        )
        raise problem.error("thing", name, message=message)


def _check_region(problem: Problem, region: Region, origin: tuple[float, float], half_size: Sequence[float]) -> None:
    bounds = [(-half_size[axis] - origin[axis], half_size[axis] - origin[axis]) for axis in range(2)]
    for row in region.ranges:
        for axis, (low, high) in enumerate(bounds):
            for value in row[axis::2]:
                if not low <= value <= high:
                    message = (
                        f"range ({' '.join(f'{number:g}' for number in row)}) lies off the table: {'xy'[axis]} = "
                        f"{value:g} is not in [{low:.2f}, {high:.2f}] m"
                    )
                    raise problem.error("region", region.name, message=message)


def part_of(problem: Problem, entities: Mapping[str, Primitive], name: str) -> tuple[str, str]:
    """The entity, or workspace, and its region (or "") that ``name`` means.

    Raises:
        BDDLError: if the entity has no such region, naming the file and the regions it has.
    """
    if name in entities:
        return name, ""
    if name not in problem.regions:
        raise problem.error("thing", name, message="this is neither an entity nor a region")
    target = problem.regions[name].target
    part = name.removeprefix(f"{target}_")
    if target in entities and part not in entities[target].regions:
        known = ", ".join(entities[target].regions) or "none"
        raise problem.error("region", name, message=f"{target} has no region {part!r}; it has {known}")
    return target, part


def joint_of(problem: Problem, entities: Mapping[str, Primitive], block: str, predicate: tuple[str, ...]) -> tuple:
    """The entity and its part whose joint ``Open``, ``Close``, ``TurnOn`` or ``TurnOff`` is about.

    Raises:
        BDDLError: if it has no such joint, naming the file, the line in ``block`` and the parts that have one.
    """
    verb, name = predicate
    workspace = name not in entities and name not in problem.regions
    thing, part = (name, "") if workspace else part_of(problem, entities, name)
    if workspace or thing not in entities or (verb, part) not in entities[thing].states:
        states = entities[thing].states if thing in entities else {}
        names = [f"{thing}_{own}" if own else thing for known, own in states if known == verb]
        rest = f": of {thing} they are {', '.join(names)}" if names else ""
        raise problem.error(block, *predicate, message=f"{name} has no joint for {verb}{rest}")
    return thing, part
