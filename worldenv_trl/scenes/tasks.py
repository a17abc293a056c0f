"""The task catalogue: what is on the table, what is asked for, where things start."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from dm_control import composer
from mujoco.batch import Batch

from worldenv_trl.scenes import panda, predicates
from worldenv_trl.scenes.arena import AGENTVIEW, TabletopArena
from worldenv_trl.scenes.camera import Camera
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.entities.storage import Cabinet
from worldenv_trl.scenes.entities.tableware import Bowl, Plate
from worldenv_trl.scenes.simulation import home_state

if TYPE_CHECKING:
    from worldenv_trl.scenes.simulation import SceneBatch

SPLITS = ("train", "test")
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
class Task:
    """A task: a scene, an instruction and a goal.

    ``goal`` is a conjunction of ``(predicate, argument, ...)``; ``task_id`` is the index in the catalogue.
    """

    name: str
    suite: str
    task_id: int
    language: str
    goal: tuple[tuple[str, ...], ...]
    placements: tuple[Placement, ...]
    max_steps: int = 64
    cameras: tuple[Camera, ...] = (AGENTVIEW,)

    def build(self) -> mujoco.MjModel:
        """Compiles the scene; cached, so treat the model as read-only."""
        return _build(self)

    def camera(self, name: str) -> Camera:
        """Raises ``ValueError`` for a camera the task does not have."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise ValueError(f"unknown camera {name!r}: {self.name} has {', '.join(c.name for c in self.cameras)}")

    def evaluate(self, scene: SceneBatch) -> np.ndarray:
        """``[n]`` bool: every predicate of the goal holds in the current state."""
        holds = np.ones(scene.num_envs, bool)
        for predicate, *arguments in self.goal:
            holds &= predicates.PREDICATES[predicate](scene, *arguments)
        return holds

    def paint(self, model: mujoco.MjModel, qpos: np.ndarray) -> None:
        """Colours that show the state: a burner glows while its stove is on."""
        for placement in self.placements:
            if placement.entity is Stove:
                Stove.paint(model, placement.name, qpos)

    def init_states(self, split: str, count: int = 50) -> np.ndarray:
        """Initial states ``[count, S]`` float64: settled, free of collisions, fixed by seed.

        ``train`` and ``test`` are disjoint; a larger count extends a smaller one.

        Raises:
            ValueError: for an unknown split or a count below 1.
            RuntimeError: if things cannot be placed without overlap, naming the last one tried.
        """
        self._check_split(split, count)
        return _init_states(self, split, count).copy()

    def _check_split(self, split: str, count: int) -> None:
        if split not in SPLITS:
            raise ValueError(f"unknown split {split!r}: it must be 'train' or 'test'")
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")


def _goal_task(
    task_id: int, name: str, language: str, goal: tuple[str, ...], placements: tuple[Placement, ...]
) -> Task:
    return Task(f"goal/{name}", "goal", task_id, language, (goal,), placements)


_TASKS: tuple[Task, ...] = (
    _goal_task(
        0, "put_the_bowl_on_the_plate", "put the bowl on the plate", ("On", "bowl", "plate"),
        (
            Placement("bowl", Bowl, (0.00, -0.10), (0.042, 0.042), radius=0.065),
            Placement("plate", Plate, (0.03, 0.12), (0.040, 0.035), radius=0.095),
        ),
    ),
    _goal_task(
        1, "open_the_top_drawer", "open the top drawer of the cabinet", ("Open", "cabinet", "top"),
        (Placement("cabinet", Cabinet, (0.03, -0.11), (0.100, 0.065), fixture=True, radius=0.15),),
    ),
    _goal_task(
        2, "turn_on_the_stove", "turn on the stove", ("TurnOn", "stove"),
        (Placement("stove", Stove, (0.030, 0.02), (0.110, 0.090), fixture=True, radius=0.18),),
    ),
)  # fmt: skip


def list_suites() -> list[str]:
    """Names of the suites that have tasks."""
    return list(dict.fromkeys(task.suite for task in _TASKS))


def list_tasks(suite: str) -> list[str]:
    """Names of a suite's tasks; raises ``ValueError`` for an unknown suite."""
    if suite not in list_suites():
        raise ValueError(f"unknown suite {suite!r}: it must be one of {', '.join(list_suites())}")
    return [task.name for task in _TASKS if task.suite == suite]


def load_task(name: str | Path) -> Task:
    """The task called ``suite/name``, or that of a file ``path.bddl``.

    Raises:
        ValueError: with the closest names for an unknown task; for a file that cannot be read, laid out or judged.
        FileNotFoundError: if there is no such file.
    """
    if str(name).endswith(".bddl"):
        from worldenv_trl.scenes.files import load_bddl  # it builds on this module

        return load_bddl(name)
    tasks = {task.name: task for task in _TASKS}
    if name not in tasks:
        close = difflib.get_close_matches(str(name), tasks, n=1, cutoff=0.3)
        hint = f"did you mean {close[0]!r}?" if close else f"known tasks: {', '.join(tasks)}"
        raise ValueError(f"unknown task {name!r}: {hint}")
    return tasks[name]


@cache
def _build(task: Task) -> mujoco.MjModel:
    arena = TabletopArena(task.cameras)
    for placement in task.placements:
        add: Callable[[composer.Entity], None] = arena.add_fixture if placement.fixture else arena.add_object
        add(placement.entity(placement.name))
    return mujoco.MjModel.from_xml_string(arena.root.to_xml_string(), arena.root.get_assets())


@cache
def _init_states(task: Task, split: str, count: int) -> np.ndarray:
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


def _draw(task: Task, rng: np.random.Generator) -> list[np.ndarray]:
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
