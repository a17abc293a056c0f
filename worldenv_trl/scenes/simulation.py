"""Many copies of one task's scene, stepped and rendered together. NumPy only."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from numbers import Integral
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco.batch import Batch

from worldenv_trl.robot import panda
from worldenv_trl.scenes import controller
from worldenv_trl.scenes.panda import SUBSTEPS
from worldenv_trl.scenes.rendering import Drawing, RendererPool, Row

if TYPE_CHECKING:
    from worldenv_trl.scenes.tasks import Task

_POSITIONS = mujoco.mjtStage.mjSTAGE_POS.value
_LARGEST_IMAGE = 4096  # px; with supersampling, what GL draws into has twice as many each way
_MAX_SPEED = 1e4  # m/s or rad/s; a simulation that is faster has blown up


class SceneBatch:
    """``num_envs`` simulations of a task.

    Fields read after ``reset`` and ``step`` are those of the current state, not one substep old. Rows never influence
    one another: a row's trajectory depends on its own state and actions only, bit for bit, whatever the batch and the
    threads.

    Args:
        task: the task.
        num_envs: number of rows ``n``.
        image_size: height and width (px), from 16 to 4096.
        cameras: cameras of the scene to render (``agentview``, ``wrist`` and what else it has), or none.
        num_threads: of physics, and processes that draw (see :class:`RendererPool`); two by default.
        pool: draws the images, instead of threads of the batch's own; the batch does not close it.

    Raises:
        ValueError: for an impossible size or an unknown camera.
        RuntimeError: if cameras are asked for and no GL backend works.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        image_size: int = 64,
        cameras: Sequence[str] = ("agentview",),
        num_threads: int | None = None,
        pool: RendererPool | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if not _is_whole(image_size) or not 16 <= image_size <= _LARGEST_IMAGE:
            raise ValueError(f"image_size must be a whole number from 16 to {_LARGEST_IMAGE} px, got {image_size!r}")
        self.task, self.num_envs, self.image_size = task, num_envs, int(image_size)
        self.model = task.build()
        known = cameras_of(task)
        for name in cameras:
            if name not in known:
                raise ValueError(f"unknown camera {name!r}: {task.name} has {', '.join(known)}")
        threads = 2 if num_threads is None else max(1, num_threads)
        self.batch = Batch(self.model, num_envs, min(threads, num_envs))
        names = [joint.name for joint in panda.JOINTS]
        self._arm = np.array([_joint_address(self.model, f"panda/{name}") for name in names])
        self._finger = _joint_address(self.model, "panda/left_finger")
        self._actuators = np.array([self.model.actuator(f"panda/{name}").id for name in (*names, "fingers")])
        self._tcp = self.model.site("panda/tcp").id
        # Bound once: live views of the state, and of the derived fields that predicates and observations read.
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._ctrl, self._targets = self.batch.bind("ctrl"), self.batch.bind("userdata")
        self._mocap_pos, self._mocap_quat = self.batch.bind("mocap_pos"), self.batch.bind("mocap_quat")
        self.xpos, self.xmat = self.batch.bind("xpos"), self.batch.bind("xmat")
        self.site_xpos, self.site_xmat = self.batch.bind("site_xpos"), self.batch.bind("site_xmat")
        self.cameras = tuple(cameras)
        self.drawing: Drawing | None = None
        self._own_pool: RendererPool | None = None
        if cameras:
            if pool is None:
                pool = self._own_pool = RendererPool(min(threads, num_envs))
            names = [known[name] for name in cameras]
            self.drawing = pool.add(self.model, names, self.image_size, num_envs, task.glows(self.model))

    def reset(self, rows: np.ndarray, sim_state: np.ndarray) -> None:
        """Puts ``rows [k]`` into integration states ``sim_state [k, S]``, exactly.

        Raises:
            ValueError: for a state of another length, or one that holds NaN.
        """
        rows, sim_state = np.asarray(rows, np.int32), np.asarray(sim_state, np.float64)
        if sim_state.shape != (len(rows), self.batch.nstate):
            raise ValueError(
                f"sim_state must be [{len(rows)}, {self.batch.nstate}] for {self.task.name}, "
                f"got {list(sim_state.shape)}"
            )
        if np.isnan(sim_state).any():
            raise ValueError(f"sim_state for {self.task.name} holds NaN")
        if len(rows):
            self.batch.state[rows] = sim_state
            self._make_current(np.unique(rows))  # the batch takes sorted rows only

    def step(self, action: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
        """One 20 Hz control step with ``action [n, 7]``; rows not ``active [n]`` keep their state bit for bit.

        Returns the rows ``[k]`` whose physics blew up; they are left in the state before this step.
        """
        return step_together([self], [action], [active])[0]

    def _make_current(self, rows: np.ndarray) -> None:
        # Derived poses only: they do not touch the integration state, so a reset to it continues identically.
        self.batch.forward(rows, stage=_POSITIONS)

    def _aim(self, rows: np.ndarray, targets: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Sets the controller's targets and what it asks of the motors; returns the state before, ``[k, S]``."""
        before = self.batch.state[rows]
        self._targets[rows] = targets
        self._ctrl[rows[:, None], self._actuators[:7]] = joints
        self._ctrl[rows, self._actuators[7]] = panda.FINGER_TRAVEL * targets[:, 12]
        return before

    def _advance(self, rows: np.ndarray, before: np.ndarray) -> np.ndarray:
        """One control step of physics; returns the rows that blew up, put back to where they were."""
        self.batch.step(rows, nstep=SUBSTEPS, stage=_POSITIONS)
        # One number a row, wrong wherever something is; almost always nothing is.
        if np.abs(self.qvel).max(initial=0.0) < _MAX_SPEED and np.isfinite(self.qpos).all():
            return rows[:0]
        with np.errstate(invalid="ignore"):
            sane = (np.abs(self.qvel[rows]) < _MAX_SPEED).all(-1) & np.isfinite(self.qpos[rows]).all(-1)
        if not sane.all():
            self.batch.state[rows[~sane]] = before[~sane]
            self._make_current(rows[~sane])
        return rows[~sane]

    def render(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Images of ``rows``: for each camera ``[len(rows), 3, H, W]`` uint8, upright."""
        if self.drawing is None:
            return {}
        return dict(zip(self.cameras, self.drawing.render(self.poses(rows)).values(), strict=True))

    def poses(self, rows: np.ndarray | None = None) -> list[Row]:
        """Where everything is in ``rows`` (copies), for a renderer."""
        chosen = slice(None) if rows is None else rows
        copies = (np.array(field[chosen]) for field in (self.qpos, self._mocap_pos, self._mocap_quat))
        return list(zip(*copies, strict=True))

    def measured_state(self) -> np.ndarray:
        """Hand position (m), axis-angle (rad) and gripper opening as they are, ``[n, 7]`` float32."""
        return measured_states([self])

    def commanded_state(self) -> np.ndarray:
        """Target position (m), axis-angle (rad) and gripper opening, ``[n, 7]`` float32."""
        rotation = controller.hand_axis_angle(self._targets[:, 3:12].reshape(-1, 3, 3))
        return np.concatenate([self._targets[:, :3], rotation, self._targets[:, 12:]], -1).astype(np.float32)

    def kinematic_state(self) -> np.ndarray:
        """Measured joint angles and the controller's targets, ``[n, 20]`` float32."""
        return np.concatenate([self.qpos[:, self._arm], self._targets], -1).astype(np.float32)

    def load(self, data: mujoco.MjData, row: int) -> None:
        """Copies where everything is in a row into ``data``."""
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = (
            self.qpos[row],
            self._mocap_pos[row],
            self._mocap_quat[row],
        )

    def success(self) -> np.ndarray:
        """Whether the goal holds now, ``[n]`` bool."""
        return self.task.evaluate(self)

    def sim_state(self) -> np.ndarray:
        """MuJoCo's integration state, controller targets included, ``[n, S]`` float64 (a copy)."""
        return self.batch.state.copy()

    def close(self) -> None:
        if self.drawing is not None and self._own_pool is not None:
            self._own_pool.close()
        self.drawing = None


def step_together(
    scenes: Sequence[SceneBatch],
    actions: Sequence[np.ndarray],
    active: Sequence[np.ndarray | None],
    executor: Executor | None = None,
) -> list[np.ndarray]:
    """``SceneBatch.step`` for several batches; those with one thread step side by side on ``executor``."""
    every = [
        np.arange(scene.num_envs, dtype=np.int32) if mask is None else np.flatnonzero(mask).astype(np.int32)
        for scene, mask in zip(scenes, active, strict=True)
    ]
    moved = np.concatenate([action[rows] for action, rows in zip(actions, every, strict=True)])
    if not len(moved):
        return every
    targets = np.concatenate([scene._targets[rows] for scene, rows in zip(scenes, every, strict=True)])
    angles = np.concatenate([scene.qpos[rows[:, None], scene._arm] for scene, rows in zip(scenes, every, strict=True)])
    targets = controller.advance_targets(targets, moved)
    joints = controller.joint_targets(angles, targets)
    broken, waiting, start = list(every), [], 0
    for index, (scene, rows) in enumerate(zip(scenes, every, strict=True)):
        if not len(rows):
            continue
        share = slice(start, start := start + len(rows))
        before = scene._aim(rows, targets[share], joints[share])
        if executor is not None and scene.batch.nthread == 1:
            waiting.append((index, executor.submit(scene._advance, rows, before)))
        else:
            broken[index] = scene._advance(rows, before)
    for index, result in waiting:
        broken[index] = result.result()
    return broken


def measured_states(scenes: Sequence[SceneBatch]) -> np.ndarray:
    """``SceneBatch.measured_state`` of several batches, one after the other."""
    position = np.concatenate([scene.site_xpos[:, scene._tcp] for scene in scenes])
    matrix = np.concatenate([scene.site_xmat[:, scene._tcp].reshape(-1, 3, 3) for scene in scenes])
    opening = np.concatenate([scene.qpos[:, scene._finger, None] for scene in scenes]) / panda.FINGER_TRAVEL
    rotation = controller.hand_axis_angle(matrix)
    return np.concatenate([position, rotation, np.clip(opening, 0, 1)], -1).astype(np.float32)


def cameras_of(task: Task) -> dict[str, str]:
    """Every camera of a task's scene: what it is called, and its name in the model; the robot's drop its prefix."""
    model = task.build()
    names = [model.camera(index).name for index in range(model.ncam)]
    return {name.removeprefix("panda/"): name for name in names}


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral)


def _joint_address(model: mujoco.MjModel, name: str) -> int:
    return int(model.jnt_qposadr[model.joint(name).id])


def home_state(model: mujoco.MjModel, q: np.ndarray, opening: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(qpos, ctrl, userdata)`` of the scene's defaults with the arm at rest at ``q [7]``."""
    data = mujoco.MjData(model)
    for joint, angle in zip(panda.JOINTS, q, strict=True):
        data.qpos[_joint_address(model, f"panda/{joint.name}")] = angle
        data.ctrl[model.actuator(f"panda/{joint.name}").id] = angle
    for side in ("left", "right"):
        data.qpos[_joint_address(model, f"panda/{side}_finger")] = panda.FINGER_TRAVEL * opening
    data.ctrl[model.actuator("panda/fingers").id] = panda.FINGER_TRAVEL * opening
    targets = controller.reset_targets(np.asarray(q, float)[None], np.array([opening]))[0]
    return data.qpos.copy(), data.ctrl.copy(), targets
