"""One model drawn with one GL context: the pixels of ``mujoco.Renderer``, for less work.

Three things are left out that cannot be seen. Geoms outside the field of view are not handed to GL. What never moves
(table, wall, foot of the robot) in front of a camera that does not move either is drawn once, with its depth, and laid
behind what moves pixel by pixel, by the rule of GL's own depth test. And the depth buffer has no stencil beside it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

# Twice the pixels each way and a mean: in software GL cheaper than MuJoCo's four samples a pixel, and unlike those not
# done under a lock that all contexts of a process share.
SUPERSAMPLING = 2
_HIDDEN = 5  # a geom group that MuJoCo does not draw
_HALVES, _QUARTER = np.uint64(0x0002_0002_0002_0002), np.uint64(2)  # of a sum of four, for each of four channels
_SLACK = 1e-3  # metres that a geom may be outside the field of view and still be drawn


class Glow(NamedTuple):
    """Geom ``geom`` has the colour ``on`` (RGBA in [0, 1]) where ``qpos[address] >= threshold``, else ``off``."""

    geom: int
    address: int
    threshold: float
    on: tuple[float, float, float, float]
    off: tuple[float, float, float, float]

    def apply(self, model: mujoco.MjModel, qpos: np.ndarray) -> None:
        model.geom_rgba[self.geom] = self.on if qpos[self.address] >= self.threshold else self.off


class Canvas:
    """Draws states of a model on the GL context that is current on the calling thread.

    Args:
        model: the compiled model; a copy of it is drawn.
        cameras: names of the cameras.
        image_size: height and width (px).
        glows: colours that depend on the state (a burner). What never moves in front of a camera that does not either
            may not glow, and nothing may be transparent.
    """

    def __init__(
        self, model: mujoco.MjModel, cameras: Sequence[str], image_size: int, glows: Sequence[Glow] = ()
    ) -> None:
        from OpenGL import GL  # only now: MuJoCo has chosen the platform, and without images there need be none

        self._gl, self._glows, size = GL, tuple(glows), SUPERSAMPLING * image_size
        self._model = model = copy.copy(model)
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = size
        self._data = data = mujoco.MjData(model)
        self._geoms, self._groups = data.geom_xpos, model.geom_group.copy()
        self._scene = mujoco.MjvScene(model, maxgeom=2 * (model.ngeom + model.nsite) + 100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option, self._rect = mujoco.MjvOption(), mujoco.MjrRect(0, 0, size, size)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        self.make_current()
        self._buffer = self._replace_depth_buffer(size)
        self._pixels, self._depth = np.zeros((size, 4 * size), np.uint8), np.zeros((size, size), np.float32)
        self._colors = self._pixels.view(np.uint32)  # one number a pixel
        # Room to calculate in: memory that is new for every image costs as much again as the calculation.
        self._nearer = np.empty((size, size), bool)
        self._sums = np.empty((image_size, 4 * size), np.uint16)
        self._means = np.empty((image_size, image_size), np.uint64)
        radius = np.where(model.geom_rbound > 0, model.geom_rbound, np.inf)  # a plane is everywhere
        self._reach = -(radius + _SLACK)[:, None]
        self._views = [_View(model, name) for name in cameras]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        for view in self._views:
            self._draw_background(view)

    def make_current(self) -> None:
        """Must come before ``draw`` where several canvases share a GL context."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def draw(self, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray, images: list[np.ndarray]) -> None:
        """Draws one state, ``qpos [nq]``, into one image ``[3, H, W]`` uint8, upright, for each camera."""
        model, data, gl = self._model, self._data, self._gl
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos, mocap_pos, mocap_quat
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        for glow in self._glows:
            glow.apply(model, qpos)
        for view, image in zip(self._views, images, strict=True):
            seen = view.distances(data, self._geoms) > self._reach
            model.geom_group[:] = np.where(seen.all(1), view.groups, _HIDDEN)
            self._render(view)
            gl.glReadPixels(0, 0, *self._depth.shape, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, self._pixels)
            if view.background is not None:
                colors, depth, farther = view.background
                gl.glReadPixels(0, 0, *self._depth.shape, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, self._depth)
                np.copyto(self._colors, colors, where=farther(self._depth, depth, out=self._nearer))
            self._shrink_into(image)

    def close(self) -> None:
        """Frees what the canvas holds of its GL context, which must be current."""
        if self._buffer is not None:
            self._gl.glDeleteRenderbuffers(1, [self._buffer])
        self._context.free()

    def _render(self, view: _View) -> None:
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, view.camera, everything, self._scene)
        mujoco.mjr_render(self._rect, self._scene, self._context)

    def _shrink_into(self, image: np.ndarray) -> None:
        """Means of the 2 x 2 blocks of the pixels, rounded; GL's rows go bottom up."""
        size, sums, means = image.shape[-1], self._sums, self._means
        np.add(self._pixels[::2], self._pixels[1::2], out=sums, dtype=np.uint16)
        pairs = sums.view(np.uint64).reshape(size, size, 2)  # one number a pixel again: its four channels of 16 bits
        np.add(pairs[..., 0], pairs[..., 1], out=means)
        np.add(means, _HALVES, out=means)
        np.right_shift(means, _QUARTER, out=means)
        image[:] = means.view(np.uint8).reshape(size, size, 8)[::-1, :, :6:2].transpose(2, 0, 1)

    def _replace_depth_buffer(self, size: int) -> int | None:
        """MuJoCo's holds 64 bits a pixel, half of them for a stencil that only reflections need."""
        gl = self._gl
        buffer = gl.glGenRenderbuffers(1)
        gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
        gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, gl.GL_DEPTH_COMPONENT32F, size, size)
        attach = gl.glFramebufferRenderbuffer
        attach(gl.GL_FRAMEBUFFER, gl.GL_DEPTH_STENCIL_ATTACHMENT, gl.GL_RENDERBUFFER, 0)
        attach(gl.GL_FRAMEBUFFER, gl.GL_DEPTH_ATTACHMENT, gl.GL_RENDERBUFFER, buffer)
        if gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER) == gl.GL_FRAMEBUFFER_COMPLETE:
            return int(buffer)
        attach(gl.GL_FRAMEBUFFER, gl.GL_DEPTH_ATTACHMENT, gl.GL_RENDERBUFFER, 0)
        attach(gl.GL_FRAMEBUFFER, gl.GL_DEPTH_STENCIL_ATTACHMENT, gl.GL_RENDERBUFFER, self._context.offDepthStencil)
        gl.glDeleteRenderbuffers(1, [buffer])
        return None

    def _draw_background(self, view: _View) -> None:
        """Gives a view the colours and depths of what never moves, and takes it out of the view's own geoms.

        Exact where those geoms are drawn before all others, which then win a tie in depth, and where nothing is seen
        through something else.
        """
        model, gl, scene = self._model, self._gl, self._scene
        view.groups = self._groups.copy()
        fixed = np.array([_never_moves(model, body) for body in model.geom_bodyid])
        fixed[np.argmin(fixed) :] = False  # the leading ones
        lights = zip(model.light_bodyid, model.light_mode, strict=True)
        still = mujoco.mjtCamLight.mjCAMLIGHT_FIXED.value
        if not (view.fixed and fixed.any() and all(mode == still and _never_moves(model, b) for b, mode in lights)):
            return
        model.geom_group[:] = self._groups
        self._render(view)
        function = gl.glGetIntegerv(gl.GL_DEPTH_FUNC)
        farther = {gl.GL_GEQUAL: np.less, gl.GL_LEQUAL: np.greater}.get(function)
        drawn = [scene.geoms[index] for index in range(scene.ngeom)]
        first = [geom.objid for geom in drawn[: int((fixed & (self._groups < 3) & (model.geom_rgba[:, 3] > 0)).sum())]]
        if farther is None or any(geom.transparent for geom in drawn) or not fixed[first].all():
            return
        model.geom_group[:] = np.where(fixed, self._groups, _HIDDEN)
        self._render(view)
        gl.glReadPixels(0, 0, *self._depth.shape, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, self._pixels)
        gl.glReadPixels(0, 0, *self._depth.shape, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, self._depth)
        view.background = (self._colors.copy(), self._depth.copy(), farther)
        view.groups[fixed] = _HIDDEN


class _View:
    """A camera: its field of view, and what of the scene it is not to draw."""

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self.index = model.camera(name).id
        self.camera = mujoco.MjvCamera()
        self.camera.fixedcamid, self.camera.type = self.index, mujoco.mjtCamera.mjCAMERA_FIXED
        half = np.radians(model.cam_fovy[self.index]) / 2
        c, s = np.cos(half), np.sin(half)
        # Normals of the field of view, inwards, in the camera's axes (it looks along -z).
        normals = np.array([(c, 0, -s), (-c, 0, -s), (0, c, -s), (0, -c, -s), (0, 0, -1)]).T
        pinhole = model.cam_projection[self.index] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
        self._normals = normals if pinhole and not model.cam_sensorsize[self.index].any() else np.zeros((3, 1))
        mode = model.cam_mode[self.index]
        body = model.cam_bodyid[self.index]
        self.fixed = mode == mujoco.mjtCamLight.mjCAMLIGHT_FIXED.value and _never_moves(model, body)
        self.groups = model.geom_group.copy()
        self.background: tuple[np.ndarray, np.ndarray, np.ufunc] | None = None

    def distances(self, data: mujoco.MjData, points: np.ndarray) -> np.ndarray:
        """How far ``points [n, 3]`` are inside each side of the field of view, ``[n, sides]`` (m)."""
        normals = data.cam_xmat[self.index].reshape(3, 3) @ self._normals
        return points @ normals - data.cam_xpos[self.index] @ normals


def _never_moves(model: mujoco.MjModel, body: int) -> bool:
    return model.body_weldid[body] == 0 and model.body_mocapid[model.body_rootid[body]] == -1
