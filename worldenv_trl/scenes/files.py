"""Tasks from BDDL files."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from worldenv_trl.robot import WRIST
from worldenv_trl.scenes.bddl import Problem, read_bddl
from worldenv_trl.scenes.canvas import Glow
from worldenv_trl.scenes.entities import Primitive
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.initial import draw_poses, load_poses, states_from_poses, stored_seed
from worldenv_trl.scenes.layout import Layout
from worldenv_trl.scenes.relations import Relations
from worldenv_trl.scenes.settings import compile_scene, setting_of
from worldenv_trl.scenes.simulation import SceneBatch
from worldenv_trl.scenes.tasks import Task

__all__ = ["FileTask", "load_bddl", "task_of"]

MAX_STEPS = 300  # LIBERO's goal suite, in openvla-oft's protocol


@dataclass(frozen=True, kw_only=True)
class FileTask(Task):
    """A task whose scene, initial states and goal come from a file.

    ``digest`` is that of what the file says (:class:`~worldenv_trl.scenes.bddl.Problem`); ``states`` is the file of
    stored initial states, if there is one. The scene has exactly the ``cameras`` of the task:
    ``dataclasses.replace(task, cameras=(*task.cameras, look_at(...)))`` is the same task with one more.
    """

    states: Path | None = None
    problem: Problem = field(compare=False, repr=False)

    def build(self) -> mujoco.MjModel:
        return _scene(self)[1]

    @property
    def seed(self) -> int:
        """What its initial states are drawn from: the stored ones' seed, without any the beginning of the digest."""
        stored = None if self.states is None else stored_seed(self, self.states)
        return int(self.digest[:15], 16) if stored is None else stored

    @property
    def entities(self) -> dict[str, Primitive]:
        """Every fixture and object by name, the workspace excepted."""
        return _scene(self)[0]

    @property
    def layout(self) -> Layout:
        """What draws initial states."""
        return _layout(self)

    @property
    def relations(self) -> Relations:
        """What judges the goal."""
        return _relations(self)

    def evaluate(self, scene: SceneBatch) -> np.ndarray:
        return self.relations.holds(scene)

    def glows(self, model: mujoco.MjModel) -> list[Glow]:
        return [entity.glow(model, name) for name, entity in self.entities.items() if isinstance(entity, Stove)]

    def init_states(self, split: str, count: int = 50) -> np.ndarray:
        self._check_split(split, count)
        stored = _stored_states(self, split)[:count]
        missing = count - len(stored)
        return np.concatenate([stored, _drawn_states(self, split, len(stored), missing)]) if missing else stored.copy()


def load_bddl(
    path: str | Path,
    *,
    max_steps: int = MAX_STEPS,
    name: str | None = None,
    suite: str = "file",
    states: Path | None = None,
) -> FileTask:
    """The task of a BDDL file.

    Args:
        path: the file.

    Keyword Args:
        max_steps: of an episode.
        name: the task's name; the path by default.
        suite: the suite it belongs to.
        states: a file of stored initial states.

    Raises:
        FileNotFoundError: if there is no such file.
        BDDLError: if it cannot be read, with file, line and token.
        ValueError: if it names an unknown problem class, category, region or joint.
    """
    path = Path(path)
    return task_of(
        read_bddl(path), name=str(path) if name is None else name, suite=suite, max_steps=max_steps, states=states
    )


def task_of(
    problem: Problem,
    *,
    name: str,
    suite: str = "file",
    max_steps: int = MAX_STEPS,
    states: Path | None = None,
    **other: Any,
) -> FileTask:
    """The task of a problem; ``other`` are fields of it that its text does not decide.

    Raises:
        ValueError: if the problem names an unknown problem class, category, region or joint.
    """
    fields: dict[str, Any] = {"language": problem.language, "cameras": (setting_of(problem).camera, WRIST)} | other
    task = FileTask(
        name=name,
        suite=suite,
        goal=problem.goal,
        max_steps=max_steps,
        digest=problem.digest,
        states=states,
        problem=problem,
        **fields,
    )
    _layout(task), _relations(task)  # what cannot be laid out or judged fails here, not in the first reset
    return task


@cache
def _scene(task: FileTask) -> tuple[dict[str, Primitive], mujoco.MjModel]:
    return compile_scene(task.problem, task.cameras)


@cache
def _layout(task: FileTask) -> Layout:
    return Layout(task.problem, *_scene(task), origin=setting_of(task.problem).origin)


@cache
def _relations(task: FileTask) -> Relations:
    return Relations(task.problem, *_scene(task), origin=setting_of(task.problem).origin)


@cache
def _stored_states(task: FileTask, split: str) -> np.ndarray:
    if task.states is None or not task.states.exists():
        return np.zeros((0, SceneBatch(task, 1, cameras=()).batch.nstate))
    return states_from_poses(task, load_poses(task, task.states)[split])


@cache
def _drawn_states(task: FileTask, split: str, start: int, count: int) -> np.ndarray:
    return states_from_poses(task, draw_poses(task, split, start, count))
