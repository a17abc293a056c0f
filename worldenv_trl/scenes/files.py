"""Tasks from BDDL files."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import Batch

from worldenv_trl.scenes import panda
from worldenv_trl.scenes.bddl import Problem, read_bddl
from worldenv_trl.scenes.entities import Primitive
from worldenv_trl.scenes.entities.cookware import Stove
from worldenv_trl.scenes.layout import Layout
from worldenv_trl.scenes.relations import Relations
from worldenv_trl.scenes.settings import compile_scene, setting_of
from worldenv_trl.scenes.simulation import SceneBatch, home_state
from worldenv_trl.scenes.tasks import SPLITS, Task

__all__ = ["FileTask", "load_bddl"]

MAX_STEPS = 300  # LIBERO's goal suite, in openvla-oft's protocol
_FIRST_ID, _IDS = 1000, 9000
_SETTLE_SUBSTEPS = 100
_ATTEMPTS = 40
_MOVED, _UPRIGHT = 0.04, 0.9  # metres; cosine of the tilt: a state that settles further away is drawn again


@dataclass(frozen=True)
class FileTask(Task):
    """A task whose scene, initial states and goal come from a file; its number follows from the file's text."""

    problem: Problem | None = field(default=None, compare=False, repr=False)

    def build(self) -> mujoco.MjModel:
        return _scene(self)[1]

    @property
    def entities(self) -> dict[str, Primitive]:
        """Every fixture and object by name, the workspace excepted."""
        return _scene(self)[0]

    @property
    def relations(self) -> Relations:
        """What judges the goal."""
        return _relations(self)

    def evaluate(self, scene: SceneBatch) -> np.ndarray:
        return self.relations.holds(scene)

    def paint(self, model: mujoco.MjModel, qpos: np.ndarray) -> None:
        for name, entity in self.entities.items():
            if isinstance(entity, Stove):
                entity.paint(model, name, qpos)

    def init_states(self, split: str, count: int = 50) -> np.ndarray:
        self._check_split(split, count)
        return _drawn_states(self, split, count).copy()


def load_bddl(path: str | Path, *, max_steps: int = MAX_STEPS) -> FileTask:
    """The task of a BDDL file.

    Raises:
        FileNotFoundError: if there is no such file.
        BDDLError: if it cannot be read, with file, line and token.
        ValueError: if it names an unknown problem class, category, region or joint.
    """
    path = Path(path)
    problem = read_bddl(path)
    task = FileTask(
        name=str(path),
        suite="file",
        task_id=_FIRST_ID + zlib.crc32(path.read_bytes()) % _IDS,
        language=problem.language,
        goal=problem.goal,
        placements=(),
        max_steps=max_steps,
        cameras=(setting_of(problem).camera,),
        problem=problem,
    )
    _layout(task), _relations(task)  # what cannot be laid out or judged fails here, not in the first reset
    return task


@cache
def _scene(task: FileTask) -> tuple[dict[str, Primitive], mujoco.MjModel]:
    return compile_scene(task.problem)


@cache
def _layout(task: FileTask) -> Layout:
    return Layout(task.problem, *_scene(task), origin=setting_of(task.problem).origin)


@cache
def _relations(task: FileTask) -> Relations:
    return Relations(task.problem, *_scene(task), origin=setting_of(task.problem).origin)


@cache
def _drawn_states(task: FileTask, split: str, count: int) -> np.ndarray:
    model, layout = task.build(), _layout(task)
    things = np.array([model.body(f"{name}/").id for name in task.problem.objects])
    batch = Batch(model, count, 2)
    data = mujoco.MjData(model)
    qpos, ctrl, targets = home_state(model, panda.HOME_Q)
    waiting = np.arange(count, dtype=np.int32)
    for attempt in range(_ATTEMPTS):
        drawn = np.zeros((len(waiting), len(things), 3))
        for row, index in enumerate(waiting):
            # One generator per state and attempt: a larger count extends a smaller one.
            rng = np.random.default_rng([task.task_id, SPLITS.index(split), int(index), attempt])
            data.qpos[:] = qpos
            layout.draw(data, rng)
            mujoco.mj_kinematics(model, data)
            drawn[row] = data.xpos[things]
            for name, value in (
                ("qpos", data.qpos), ("qvel", 0.0), ("mocap_pos", data.mocap_pos), ("mocap_quat", data.mocap_quat),
                ("ctrl", ctrl), ("userdata", targets), ("qacc_warmstart", 0.0),
            ):  # fmt: skip
                batch.bind(name)[index] = value
        batch.step(waiting, nstep=_SETTLE_SUBSTEPS)
        batch.forward(waiting, stage=mujoco.mjtStage.mjSTAGE_POS.value)
        moved = np.linalg.norm(batch.bind("xpos")[waiting][:, things] - drawn, axis=-1).max(-1, initial=0.0)
        upright = batch.bind("xmat")[waiting][:, things].reshape(len(waiting), len(things), 9)[..., 8]
        fine = (moved < _MOVED) & (upright.min(-1, initial=1.0) > _UPRIGHT)
        waiting = waiting[~fine]
        if not len(waiting):
            break
    else:
        raise RuntimeError(
            f"{task.name}: initial state {int(waiting[0])} does not come to rest in {_ATTEMPTS} tries: "
            "something falls or is pushed away from its region in :init"
        )
    batch.bind("time")[:] = 0.0
    return batch.state.copy()
