"""Demonstrations in places where none was given: the scene and the hand moved over the table together."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor

from worldenv_trl.keys import STATE, WAYPOINT, image_key
from worldenv_trl.kinematics.calibrations import Calibrations, check_instructions, plain_cameras
from worldenv_trl.kinematics.planes import plane, warped
from worldenv_trl.language import instructions_of
from worldenv_trl.robot import Camera
from worldenv_trl.row_share import own_rows

__all__ = ["SceneShift"]


class SceneShift:
    """Moves everything over the table, the hand included, each sample by a distance of its own.

    Where things stand and where the hand is change together, and what the hand has to do, which actions tell relative
    to where it is, stays the same: an equivariance that a policy of few demonstrations does not find by itself. The
    image is warped by the homography of a horizontal plane; what lies on it moves exactly, what rises above it
    by a parallax that grows with the distance, so small ones are meant. The position in ``("observation", "state")``
    moves as far, and the waypoint, if there is one. A camera that is mounted on the tool sees what it saw. (DrQ's
    random shift, arXiv:2004.13649, moves the image and says nothing of the hand; DemoGen, arXiv:2502.16932, moves
    objects in point clouds.)

    Args:
        cameras: ``{camera name: {instruction: camera}}``, what each instruction's scene is seen through.
        reach: largest distance (m) along each of the table's two axes, drawn uniformly.
        share: of the samples that are moved, in [0, 1].
        height: of the plane (m), for all or ``{instruction: height}``: best where the hand takes hold of things, so
            that hand and thing are seen to meet there.

    Raises:
        ValueError: for a negative reach, a share out of range, or cameras of different instructions.

    Examples:
        >>> from tensordict import NonTensorStack, TensorDict
        >>> from worldenv_trl.robot import look_at
        >>> front = look_at("agentview", (0.8, 0.0, 0.6), (0.0, 0.0, 0.1), 40.0)
        >>> shift = SceneShift({"agentview": {"do it": front}}, reach=0.03)
        >>> images, state = torch.zeros(2, 3, 64, 64, dtype=torch.uint8), torch.zeros(2, 7)
        >>> batch = TensorDict({"observation": {"image": images, "state": state}}, [2])
        >>> moved = shift(batch.set("language_instruction", NonTensorStack("do it", "do it")))
        >>> moved["observation", "image"].dtype, moved["observation", "state"][:, :2].abs().max() <= 0.03
        (torch.uint8, tensor(True))
    """

    def __init__(
        self,
        cameras: Mapping[str, Mapping[str, Camera]],
        reach: float,
        share: float = 0.7,
        height: float | Mapping[str, float] = 0.03,
    ) -> None:
        check_moves(reach, share)
        plain = plain_cameras(cameras)
        check_instructions(plain, "SceneShift")
        self._views = {name: Calibrations(each) for name, each in plain.items()}
        self.reach, self.share, self.height = reach, share, height

    def __call__(self, samples: TensorDictBase) -> TensorDictBase:
        """A shallow copy of ``samples`` [B] with images of its cameras, uint8 [B, 3, H, W], and states [B, 7] moved.

        Raises:
            KeyError: if the image of a camera is missing, or an instruction's height.
        """
        out, state = samples.copy(), samples[STATE].clone()
        move = draw_moves(len(samples), self.reach, self.share).to(state.device)
        state[:, :2] += move
        out[STATE] = state
        if WAYPOINT in samples.keys(include_nested=True):
            out[WAYPOINT] = samples[WAYPOINT] + F.pad(move, (0, 1))
        texts = instructions_of(samples)
        heights = [self.height[text] if isinstance(self.height, Mapping) else self.height for text in texts]
        height = torch.tensor(heights, dtype=state.dtype, device=state.device)
        for name, views in self._views.items():
            images = samples[image_key(name)].clone()
            height, move = height.to(images.device), move.to(images.device)
            for camera, rows in views.rows(texts):
                if camera.mount == "world":
                    # A pixel shows the point of the plane that it now sees, where that point was before.
                    seen = plane(camera, images.shape[-2:], height[rows])
                    images[rows] = warped(images[rows], camera, seen - F.pad(move[rows], (0, 1))[:, None, None])
            out[image_key(name)] = images
        return out


def check_moves(reach: float, share: float) -> None:
    """Raises ``ValueError`` unless samples can be moved so far (m), and so many of them."""
    if not 0 <= reach < math.inf:
        raise ValueError(f"reach must be at least 0 m, got {reach}")
    if not 0 <= share <= 1:
        raise ValueError(f"share must lie between 0 and 1, got {share}")


def draw_moves(count: int, reach: float, share: float) -> Tensor:
    """[count, 2]: uniform up to ``reach`` along either axis for a ``share`` of the rows, zero for the others."""
    # One call draws both, so that processes that share a batch agree on the numbers of each row.
    drawn = own_rows(lambda rows: torch.rand(rows, 3), count)
    return (2 * drawn[:, :2] - 1) * reach * (drawn[:, 2:] < share)
