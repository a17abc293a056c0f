"""Three small scenes for the recipes' presets: one or two things on the table, episodes of at most 64 steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from dm_control import composer
from mujoco.batch import Batch

from worldenv_trl.scenes import panda, predicates
from worldenv_trl.scenes.arena import TabletopArena
from worldenv_trl.scenes.canvas import Glow
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Bowl, Plate
from worldenv_trl.scenes.simulation import home_state
from worldenv_trl.scenes.tasks import SPLITS, Task

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

__all__ = ["STARTER_TASKS", "SUITE", "Placement", "StarterTask"]

SUITE = "starter"
_SETTLE_SUBSTEPS = 60
_MAX_TRIES = 200


@dataclass(frozen=True)
class Placement:
    """One thing on the table: an entity, and the rectangle (centre and half size, m) its origin is drawn from."""

    name: str
    entity: type[composer.Entity]
    center: tuple[float, float]
    half_size: tuple[float, float]
    fixture: bool = False
    radius: float = 0.0
    """Horizontal radius kept free of other things when an initial state is drawn."""


@dataclass(frozen=True)
class StarterTask(Task):
    """A task laid out in Python: what stands where."""

    placements: tuple[Placement, ...] = ()

    def build(self) -> mujoco.MjModel:
        return _build(self)

    def evaluate(self, scene: SceneBatch) -> np.ndarray:
        holds = np.ones(scene.num_envs, bool)
        for predicate, *arguments in self.goal:
            holds &= predicates.PREDICATES[predicate](scene, *arguments)
        return holds

    def glows(self, model: mujoco.MjModel) -> list[Glow]:
        return [Stove.glow(model, placement.name) for placement in self.placements if placement.entity is Stove]

    def init_states(self, split: str, count: int = 50) -> np.ndarray:
        self._check_split(split, count)
        return _init_states(self, split, count).copy()


def _task(
    task_id: int, name: str, language: str, goal: tuple[str, ...], placements: tuple[Placement, ...]
) -> StarterTask:
    return StarterTask(f"{SUITE}/{name}", SUITE, task_id, language, (goal,), placements=placements)


STARTER_TASKS: tuple[StarterTask, ...] = (
    _task(
        0, "put_the_bowl_on_the_plate", "put the bowl on the plate", ("On", "bowl", "plate"),
        (
            Placement("bowl", Bowl, (0.00, -0.10), (0.042, 0.042), radius=0.065),
            Placement("plate", Plate, (0.03, 0.12), (0.040, 0.035), radius=0.095),
        ),
    ),
    _task(
        1, "open_the_top_drawer", "open the top drawer of the cabinet", ("Open", "cabinet", "top"),
        (Placement("cabinet", Cabinet, (0.03, -0.11), (0.100, 0.065), fixture=True, radius=0.15),),
    ),
    _task(
        2, "turn_on_the_stove", "turn on the stove", ("TurnOn", "stove"),
        (Placement("stove", Stove, (0.030, 0.02), (0.110, 0.090), fixture=True, radius=0.18),),
    ),
)  # fmt: skip


@cache
def _build(task: StarterTask) -> mujoco.MjModel:
    arena = TabletopArena(task.cameras)
    for placement in task.placements:
        add: Callable[[composer.Entity], None] = arena.add_fixture if placement.fixture else arena.add_object
        add(placement.entity(placement.name))
    return mujoco.MjModel.from_xml_string(arena.root.to_xml_string(), arena.root.get_assets())


@cache
def _init_states(task: StarterTask, split: str, count: int) -> np.ndarray:
    model = task.build()
    batch = Batch(model, count, 2)
    qpos, ctrl, targets = home_state(model, panda.HOME_Q)
    batch.bind("qpos")[:], batch.bind("ctrl")[:], batch.bind("userdata")[:] = qpos, ctrl, targets
    positions, mocap = batch.bind("qpos"), batch.bind("mocap_pos")
    for index in range(count):
        # One generator per state: a larger count extends a smaller one.
        rng = np.random.default_rng([task.task_id, SPLITS.index(split), index])
        for placement, place in zip(task.placements, _draw(task, rng), strict=True):
            body = model.body(f"{placement.name}/").id
            if placement.fixture:
                mocap[index, model.body_mocapid[body]] = (*place, 0.0)
            else:
                start = model.jnt_qposadr[model.body_jntadr[body]]
                positions[index, start : start + 3] = (*place, 0.001)
                positions[index, start + 3 : start + 7] = (1, 0, 0, 0)
    batch.step(nstep=_SETTLE_SUBSTEPS)
    batch.bind("time")[:] = 0.0
    return batch.state.copy()


def _draw(task: StarterTask, rng: np.random.Generator) -> list[np.ndarray]:
    for _ in range(_MAX_TRIES):
        places = [np.array(p.center) + rng.uniform(-1, 1, 2) * np.array(p.half_size) for p in task.placements]
        clear = all(
            np.linalg.norm(places[i] - places[j]) > task.placements[i].radius + task.placements[j].radius
            for i in range(len(places))
            for j in range(i)
        )
        if clear:
            return places
    raise RuntimeError(
        f"{task.name}: {task.placements[-1].name} cannot be placed clear of the rest in {_MAX_TRIES} tries"
    )
