"""Initial states of task files: drawn, left to come to rest, and kept as poses of what is not the robot.

A pose is stored as float32; the state made from it has the arm at home and everything at rest, so a drawn state and one
read from a file are the same, bit for bit.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from worldenv_trl.context_ids import SPLITS
from worldenv_trl.robot import panda
from worldenv_trl.scenes.simulation import SceneBatch, home_state

if TYPE_CHECKING:
    from worldenv_trl.scenes.files import FileTask

__all__ = ["Check", "draw_poses", "drawn_scene", "load_poses", "save_poses", "states_from_poses", "stored_seed"]

Check = Callable[[np.ndarray], np.ndarray]
"""Which of the integration states ``[n, S]`` may be kept, ``[n]`` bool: those that an expert solves, say."""

_SETTLE_SUBSTEPS = 100
_ATTEMPTS, _REFUSALS = 40, 10
_IN_VAIN = 100  # draws; when not one of so many comes to rest, no more are tried
_MOVED, _UPRIGHT = 0.04, 0.9  # metres; cosine of the tilt: a state that settles further away is drawn again


def draw_poses(task: FileTask, split: str, start: int, count: int) -> np.ndarray:
    """Poses ``[count, P]`` float32 of states from number ``start`` on: at rest, the goal not yet fulfilled.

    Nobody has tried whether the goal can be reached from them: :func:`save_poses` does.

    Raises:
        RuntimeError: if things cannot be placed clear of each other, or do not come to rest where they were placed.
    """
    return _draw(task, split, start, count, None)[0]


def _draw(task: FileTask, split: str, start: int, count: int, check: Check | None) -> tuple[np.ndarray, np.ndarray]:
    """The poses ``[count, P]``, and how often ``check`` has refused each state ``[count]``."""
    model = task.build()
    things = np.array([model.body(f"{name}/").id for name in task.problem.objects], int)
    scene = SceneBatch(task, count, cameras=())
    data = mujoco.MjData(model)
    qpos, ctrl, targets = home_state(model, panda.HOME_Q)
    bind = scene.batch.bind
    waiting, refusals, seed = np.arange(count, dtype=np.int32), np.zeros(count, int), task.seed
    for attempt in range(_ATTEMPTS):
        drawn = np.zeros((len(waiting), len(things), 3))
        for row, index in enumerate(waiting):
            # One generator per state and attempt: a larger count extends a smaller one.
            rng = np.random.default_rng([seed, SPLITS.index(split), start + int(index), attempt])
            data.qpos[:] = qpos
            _lay_out(task, scene, int(index), data, rng)
            mujoco.mj_kinematics(model, data)
            drawn[row] = data.xpos[things]
            for name, value in (("qvel", 0.0), ("ctrl", ctrl), ("userdata", targets), ("qacc_warmstart", 0.0)):
                bind(name)[index] = value
        scene.batch.step(waiting, nstep=_SETTLE_SUBSTEPS)
        scene.batch.forward(waiting, stage=mujoco.mjtStage.mjSTAGE_POS.value)
        away = np.linalg.norm(scene.xpos[waiting][:, things] - drawn, axis=-1)
        moved = away.max(-1, initial=0.0)
        upright = scene.xmat[waiting][:, things].reshape(len(waiting), len(things), 9)[..., 8]
        if len(waiting) == count and (attempt + 1) * count >= _IN_VAIN:
            _check_some_settle(task, away, upright, scene.success(), (attempt + 1) * count)
        fine = (moved < _MOVED) & (upright.min(-1, initial=1.0) > _UPRIGHT) & ~scene.success()[waiting]
        if check is not None and fine.any():
            rows = waiting[fine]
            refused = ~check(states_from_poses(task, _poses(scene)[rows]))
            refusals[rows[refused]] += 1
            fine[fine] = ~refused
            if refusals.max() == _REFUSALS:
                raise RuntimeError(
                    f"{task.name}: {split} initial state {start + int(refusals.argmax())} is not solved in any of "
                    f"{_REFUSALS} draws: narrow the regions in the file, or mend the expert"
                )
        waiting = waiting[~fine]
        if not len(waiting):
            return _poses(scene), refusals
    raise RuntimeError(
        f"{task.name}: {split} initial state {start + int(waiting[0])} does not come to rest in {_ATTEMPTS} tries: "
        "something falls, is pushed away from its region in :init, or fulfils the goal at once"
    )


def drawn_scene(task: FileTask, count: int) -> SceneBatch:
    """A scene of ``count`` layouts such as initial states are drawn from: nothing has come to rest yet.

    Raises:
        RuntimeError: if things cannot be placed clear of each other.
    """
    scene, data = SceneBatch(task, count, cameras=()), mujoco.MjData(task.build())
    rng = np.random.default_rng(task.seed)
    for row in range(count):
        _lay_out(task, scene, row, data, rng)
    scene.batch.forward(np.arange(count, dtype=np.int32), stage=mujoco.mjtStage.mjSTAGE_POS.value)
    return scene


def _lay_out(task: FileTask, scene: SceneBatch, row: int, data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Draws a layout into ``data`` and into a row of the scene."""
    task.layout.draw(data, rng)
    for name in ("qpos", "mocap_pos", "mocap_quat"):
        scene.batch.bind(name)[row] = getattr(data, name)


def states_from_poses(task: FileTask, poses: np.ndarray) -> np.ndarray:
    """Integration states ``[n, S]`` float64 with things at ``poses [n, P]`` and the arm at home, all at rest."""
    scene = SceneBatch(task, len(poses), cameras=())
    bind = scene.batch.bind
    qpos, ctrl, targets = home_state(task.build(), panda.HOME_Q)
    bind("qpos")[:], bind("ctrl")[:], bind("userdata")[:] = qpos, ctrl, targets
    free = _free(task.build())
    mocap = bind("mocap_pos").shape[1]
    joints, places, turns = np.split(poses.astype(np.float64), [len(free), len(free) + 3 * mocap], axis=-1)
    bind("qpos")[:, free] = joints
    bind("mocap_pos")[:] = places.reshape(len(poses), mocap, 3)
    bind("mocap_quat")[:] = turns.reshape(len(poses), mocap, 4)
    return scene.batch.state.copy()


def load_poses(task: FileTask, path: Path) -> dict[str, np.ndarray]:
    """The stored poses ``[n, P]`` of each split.

    Raises:
        RuntimeError: if the file belongs to another version of the task, or holds something else.
    """
    remedy = f"python recipes/init_states.py --tasks {task.name}"
    try:
        with np.load(path, allow_pickle=False) as stored:
            poses = {split: stored[split] for split in SPLITS}
            digest = str(stored["digest"])
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise RuntimeError(
            f"{path} holds no initial states ({error}), and where it lies those of {task.name} are looked for: move it "
            f"away; {remedy} makes new ones"
        ) from error
    width = len(_free(task.build())) + 7 * task.build().nmocap
    if digest != task.digest or any(array.shape[1:] != (width,) for array in poses.values()):
        raise RuntimeError(
            f"{path.name} holds initial states of another version of {task.name}: make them again with {remedy}"
        )
    return poses


def stored_seed(task: FileTask, path: Path) -> int | None:
    """What the initial states in ``path`` were drawn from, so that more of them continue those that are there.

    None if there is no such file, or one that holds something other than states of this version of the task.
    """
    if not path.exists() or not _holds_states(path):
        return None
    with np.load(path, allow_pickle=False) as stored:
        return int(stored["seed"]) if "seed" in stored and str(stored["digest"]) == task.digest else None


def save_poses(task: FileTask, path: Path, count: int, check: Check | None = None) -> dict[str, np.ndarray]:
    """Draws ``count`` states of each split and writes their poses, in place of what ``path`` held.

    A state that ``check`` refuses is drawn again, by the next generator of the same number; the others stay as they
    are.

    Returns:
        For each split, how often each state was drawn again because of ``check``, ``[count]``.

    Raises:
        RuntimeError: as :func:`draw_poses`, if ``check`` refuses ten draws of a state, and if ``path`` holds something
            other than initial states; nothing is written then.
    """
    if path.exists() and not _holds_states(path):
        raise RuntimeError(f"{path} holds something other than initial states of {task.name}: move it away first")
    drawn = {split: _draw(task, split, 0, count, check) for split in SPLITS}
    poses = {split: poses for split, (poses, _) in drawn.items()}
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            arrays: dict[str, Any] = {"digest": np.str_(task.digest), "seed": np.int64(task.seed), **poses}
            np.savez_compressed(file, **arrays)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return {split: refusals for split, (_, refusals) in drawn.items()}


def _holds_states(path: Path) -> bool:
    """Whether a file holds initial states, of whatever task and version."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return set(stored) - {"seed"} == {"digest", *SPLITS}
    except (TypeError, ValueError, EOFError, zipfile.BadZipFile):
        return False


def _check_some_settle(task: FileTask, away: np.ndarray, upright: np.ndarray, solved: np.ndarray, draws: int) -> None:
    """Raises ``RuntimeError`` if no row is an initial state, from how far things ``[n, things]`` strayed and lean."""
    problem = task.problem
    stray = (away >= _MOVED) | (upright <= _UPRIGHT)
    if not (stray.any(-1) | solved).all():
        return
    if not stray.any(-1).all():
        where = problem.where("goal", *problem.goal[0])
        raise RuntimeError(f"{where}: the goal holds in all of {draws} draws: place things elsewhere in :init")
    worst = int(stray.mean(0).argmax())
    name, far = list(problem.objects)[worst], 100 * np.median(away[:, worst])
    where = problem.where("init", *next(whole for whole in problem.init if whole[1] == name and len(whole) == 3))
    raise RuntimeError(
        f"{where}: {name} does not come to rest there in any of {draws} draws: it falls, tips over or is pushed "
        f"{far:.0f} cm away: move its place, or make room"
    )


def _free(model: mujoco.MjModel) -> np.ndarray:
    """Addresses in ``qpos`` of everything but the robot."""
    robot = {int(model.jnt_qposadr[j]) for j in range(model.njnt) if model.joint(j).name.startswith("panda/")}
    return np.array([address for address in range(model.nq) if address not in robot])


def _poses(scene: SceneBatch) -> np.ndarray:
    """``[n, P]`` float32 of every row as it is now."""
    parts = scene.qpos[:, _free(scene.model)], scene.batch.bind("mocap_pos"), scene.batch.bind("mocap_quat")
    return np.concatenate([part.reshape(scene.num_envs, -1) for part in parts], -1).astype(np.float32)
