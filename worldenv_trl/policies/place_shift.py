"""Demonstrations with the thing, or its place, somewhere else: what lies there is moved, and the actions with it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor

from worldenv_trl.keys import APPROACH, CHUNK, POSITION_STEP, STATE, WAYPOINT, image_key
from worldenv_trl.kinematics.calibrations import Calibrations, check_instructions, plain_cameras
from worldenv_trl.kinematics.planes import plane, warped
from worldenv_trl.language import instructions_of
from worldenv_trl.policies.scene_shift import check_moves, draw_moves
from worldenv_trl.robot import Camera

__all__ = ["PlaceShift"]

_STEEPEST = 1.5  # slope of the smooth step between the radii, times their distance


class PlaceShift:
    """Moves what lies where the gripper next closes or opens, or puts what it holds, each sample by its own distance.

    The rest of the image stays, the actions bring the hand to where the thing is now, and nothing but the thing tells
    where that is. Of five demonstrations a policy learns otherwise to replay one after seeing which of them it
    is in: then the hand closes at the same place wherever the thing stands. (DemoGen, arXiv:2502.16932, edits point
    clouds and trajectories; MimicGen, arXiv:2310.17596, needs a simulator.)

    On the level plane through that place all within ``inner`` moves, nothing beyond ``outer``, smoothly less
    between. A hand that is seen within moves with what is there, and the actions make up for the rest, as
    ``("vla_action", "approach")`` shares it out. Things that rise above the plane move by a parallax more, and what is
    between bends: small distances are meant. Samples with no such place ahead stay as they are.

    Args:
        cameras: ``{camera name: {instruction: camera}}``, what each instruction's scene is seen through, none of them
            mounted on the tool; in the first one is seen how far the hand moves with the thing.
        reach: largest distance (m) along each of the table's two axes, drawn uniformly.
        share: of the samples that are changed, in [0, 1].
        inner, outer: radii (m).

    Raises:
        ValueError: for a reach below 0 or one that folds the image, a share or radii out of range, a camera on the
            tool, or cameras of different instructions.
    """

    def __init__(
        self,
        cameras: Mapping[str, Mapping[str, Camera]],
        reach: float,
        share: float = 0.7,
        inner: float = 0.06,
        outer: float = 0.14,
    ) -> None:
        check_moves(reach, share)
        if not 0 <= inner < outer:
            raise ValueError(f"inner must be at least 0 m and less than outer, got {inner} and {outer}")
        if _STEEPEST * math.sqrt(2) * reach >= outer - inner:  # along both axes at once
            raise ValueError(
                f"reach must be less than {(outer - inner) / _STEEPEST / math.sqrt(2):.3f} m with these radii, got "
                f"{reach}: moved further, what is between them folds over itself"
            )
        plain = plain_cameras(cameras)
        check_instructions(plain, "PlaceShift")
        self._views = {name: Calibrations(each) for name, each in plain.items()}
        for name, views in self._views.items():
            if views.any_mounted:
                raise ValueError(
                    f"the camera {name} is mounted on the tool and would show the thing where it was: move no places "
                    "(sft.place_shift_m 0), or let the policy look through the others alone (sft.cameras)"
                )
        self._first = next(iter(self._views))
        self.reach, self.share, self.inner, self.outer = reach, share, inner, outer

    def __call__(self, samples: TensorDictBase) -> TensorDictBase:
        """A shallow copy of samples [B] of :func:`~worldenv_trl.data.policy_samples` with images, states, chunks and
        waypoints changed.

        Raises:
            KeyError: if an entry is missing.
        """
        out, place, approach = samples.copy(), samples[WAYPOINT], samples[APPROACH]
        move = draw_moves(len(samples), self.reach, self.share).to(place.device)
        move *= approach.sum(-1, keepdim=True) > 0
        texts, carried = instructions_of(samples), place.new_zeros(len(samples))  # of the move, with the thing
        for name, views in self._views.items():
            images = samples[image_key(name)].clone()
            for camera, rows in views.rows(texts):
                rows = rows[(move[rows] != 0).any(-1).cpu()]
                at, by = place[rows].to(images.device), move[rows].to(images.device)
                seen = plane(camera, images.shape[-2:], at[:, 2])
                part = self._part((seen[..., :2] - (at[:, :2] + by)[:, None, None]).norm(dim=-1))
                images[rows] = warped(images[rows], camera, seen - F.pad(part[..., None] * by[:, None, None], (0, 1)))
                if name == self._first:
                    carried[rows] = self._part(_seen_at(samples[STATE][rows, :3], camera, at[:, 2], at[:, :2]))
            out[image_key(name)] = images
        state, chunk = samples[STATE].clone(), samples[CHUNK].clone()
        state[:, :2] += carried[:, None] * move
        chunk[..., :2] += ((1 - carried)[:, None] * move)[:, None] * approach[..., None] / POSITION_STEP
        out[STATE], out[CHUNK] = state, chunk.clamp(-1, 1)
        out[WAYPOINT] = place + F.pad(move, (0, 1))
        return out

    def _part(self, distance: Tensor) -> Tensor:
        """1 within the inner radius, 0 beyond the outer one, smooth between."""
        inward = ((self.outer - distance) / (self.outer - self.inner)).clamp(0, 1)
        return inward * inward * (3 - 2 * inward)


def _seen_at(hand: Tensor, camera: Camera, height: Tensor, place: Tensor) -> Tensor:
    """How far from ``place`` [n, 2] the hand [n, 3] is seen on the plane at ``height`` [n]: [n] (m)."""
    eye = hand.new_tensor(camera.position)
    along = (height - eye[2]) / (hand[:, 2] - eye[2]).clamp(max=-1e-3)
    return (eye[:2] + along[:, None] * (hand[:, :2] - eye[:2]) - place).norm(dim=-1)
