"""Many copies of one task's scene, stepped and rendered together. NumPy only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco.batch import Batch

from worldenv_trl.scenes import controller, panda
from worldenv_trl.scenes.rendering import RendererPool

if TYPE_CHECKING:
    from worldenv_trl.scenes.tasks import Task

_POSITIONS = mujoco.mjtStage.mjSTAGE_POS.value
_MAX_SPEED = 1e4  # m/s or rad/s; a simulation that is faster has blown up


class SceneBatch:
    """``num_envs`` simulations of a task.

    Fields read after ``reset`` and ``step`` are those of the current state, not one substep old. Rows never influence
    one another: a row's trajectory depends on its own state and actions only, bit for bit, whatever the batch and the
    threads.

    Args:
        task: the task.
        num_envs: number of rows ``n``.
        image_size: height and width (px), at least 16.
        cameras: cameras to render (``agentview``, ``wrist``), or none.
        num_threads: threads for physics and rendering; default: one per core, two at most.

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
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if image_size < 16:
            raise ValueError(f"image_size must be at least 16 px, got {image_size}")
        self.task, self.num_envs, self.image_size = task, num_envs, image_size
        self.model = task.build()
        known = {_short_name(full): full for full in (self.model.camera(i).name for i in range(self.model.ncam))}
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
        self.cameras, self.renderers = tuple(cameras), None
        if cameras:
            names = [known[name] for name in cameras]
            self.renderers = RendererPool(self.model, names, image_size, min(threads, num_envs), task.paint)

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
        rows = np.arange(self.num_envs) if active is None else np.flatnonzero(active)
        if not len(rows):
            return rows
        before = self.batch.state[rows]
        self._targets[rows] = controller.advance_targets(self._targets[rows], action[rows])
        self._ctrl[np.ix_(rows, self._actuators[:7])] = controller.joint_targets(
            self.qpos[np.ix_(rows, self._arm)], self._targets[rows]
        )
        self._ctrl[rows, self._actuators[7]] = panda.FINGER_TRAVEL * self._targets[rows, 12]
        rows = rows.astype(np.int32)
        self.batch.step(rows, nstep=panda.SUBSTEPS)
        with np.errstate(invalid="ignore"):
            sane = (np.abs(self.qvel[rows]) < _MAX_SPEED).all(-1) & np.isfinite(self.qpos[rows]).all(-1)
        if not sane.all():
            self.batch.state[rows[~sane]] = before[~sane]
        self._make_current(rows)
        return rows[~sane]

    def _make_current(self, rows: np.ndarray) -> None:
        # Derived poses only: they do not touch the integration state, so a reset to it continues identically.
        self.batch.forward(rows, stage=_POSITIONS)

    def render(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Images of ``rows``: for each camera ``[len(rows), 3, H, W]`` uint8, upright."""
        if self.renderers is None:
            return {}
        rows = slice(None) if rows is None else rows
        images = self.renderers.render(self.qpos[rows], self._mocap_pos[rows], self._mocap_quat[rows])
        return dict(zip(self.cameras, images.values(), strict=True))

    def measured_state(self) -> np.ndarray:
        """Hand position (m), axis-angle (rad) and gripper opening as they are, ``[n, 7]`` float32."""
        rotation = controller.hand_axis_angle(self.site_xmat[:, self._tcp].reshape(-1, 3, 3))
        opening = self.qpos[:, self._finger, None] / panda.FINGER_TRAVEL
        return np.concatenate([self.site_xpos[:, self._tcp], rotation, np.clip(opening, 0, 1)], -1).astype(np.float32)

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
        if self.renderers is not None:
            self.renderers.close()
            self.renderers = None


def _short_name(camera: str) -> str:
    return camera.removeprefix("panda/")


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
