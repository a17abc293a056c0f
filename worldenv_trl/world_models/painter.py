"""The last layer of the video world model: for every pixel, which of five pictures it is taken from."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worldenv_trl.world_models.cells import to_cells

__all__ = ["Painter"]

_CANDIDATES = 5  # last frame, first frame, moved last frame, painted, hand
_HAND_TEXELS = (40, 36)  # about the image's resolution for a hand 0.3 m long
_HAND_GAIN = 25.0  # the texture has much further to travel than a weight of the network


class Painter(nn.Module):
    """Composes the frames of one camera from a frame's features.

    For every pixel of every frame it chooses, by a softmax, between

    - the last frame (a static pixel is an exact copy: free and sharp),
    - the first frame (what the arm uncovers),
    - the last frame moved along with the tool's motion on the image plus a predicted residual flow (the arm, and what
      it holds or pushes, stay sharp instead of being painted again in every chunk),
    - freely painted colour,
    - the hand: a learned texture on a plane that the tool carries, shown where projection puts it (one texture for open
      fingers, one for closed). It stays sharp because all frames of all episodes share it.

    Args:
        image_size: side in pixels.
        patch: pixels per cell.
        in_channels: of a frame's features.
        hidden_channels: of the layer in between.
    """

    _base: Tensor

    def __init__(self, image_size: int, patch: int, in_channels: int, hidden_channels: int) -> None:
        super().__init__()
        self.patch = patch
        self.frame_out = nn.Conv2d(in_channels, hidden_channels, 3, padding=1)
        self.paint = nn.Conv2d(hidden_channels, (_CANDIDATES + 3 + 2) * patch**2, 1)  # weights, colour, flow
        nn.init.zeros_(self.paint.weight)
        with torch.no_grad():
            assert self.paint.bias is not None
            self.paint.bias.zero_()
            self.paint.bias[: patch**2] = 2.0  # starts as a copy of the last frame
        self.hand = nn.Parameter(torch.zeros(1, 2 * 4, *_HAND_TEXELS))  # closed and open: colour, weight
        axis = (torch.arange(image_size, dtype=torch.float32) + 0.5) * 2 / image_size - 1
        base = torch.stack([to_cells(plane, patch) for plane in torch.meshgrid(axis, axis, indexing="xy")], -1)
        self.register_buffer("_base", base, persistent=False)  # where every pixel is: [P, h, w, 2]

    def forward(self, features: Tensor, memory: Tensor, motion: Tensor, hand: Tensor, opening: Tensor) -> Tensor:
        """Frames float32 [B, C, 3, P, h, w].

        Args:
            features: [B C, D, h, w].
            memory: [B, M, 3, H, W] in [-1, 1].
            motion: [B, C, 2], of the tool on the image since the last frame, in pixels.
            hand: [B, C, 2, 3], affine map from the image's coordinates to those of the texture, both in [-1, 1].
            opening: [B, C], of the gripper.
        """
        (batch, chunk), cell = motion.shape[:2], self.patch**2
        motion = motion.view(batch, chunk, 1, 1, 1, 2)
        last, first = (to_cells(memory[:, index], self.patch).unsqueeze(1) for index in (-1, 0))
        painted = self.paint(F.silu(self.frame_out(features))).float().contiguous().unflatten(1, (-1, cell))
        painted = painted.unflatten(0, (batch, chunk))
        sprite = self._hand(hand, opening)  # [B, C, 4, P, h, w]
        weight = torch.cat(
            [painted[:, :, : _CANDIDATES - 1], painted[:, :, _CANDIDATES - 1 : _CANDIDATES] + sprite[:, :, 3:]], 2
        )
        weight = weight.softmax(2).unsqueeze(3)  # [B, C, 5, 1, P, h, w]
        colour, flow = painted[:, :, _CANDIDATES : _CANDIDATES + 3], painted[:, :, _CANDIDATES + 3 :]
        moved = self.move(memory[:, -1], motion + flow.movedim(2, -1))
        chosen = weight[:, :, 0] * last
        chosen = torch.addcmul(chosen, weight[:, :, 1], first)
        chosen = torch.addcmul(chosen, weight[:, :, 2], moved)
        chosen = torch.addcmul(chosen, weight[:, :, 3], colour)
        return torch.addcmul(chosen, weight[:, :, 4], sprite[:, :, :3])

    def _hand(self, affine: Tensor, opening: Tensor) -> Tensor:
        """Colour and weight of the hand's texture at every pixel: [B, C, 2, 3], [B, C] -> [B, C, 4, P, h, w]."""
        (batch, chunk), (cell, height, width, _) = opening.shape, self._base.shape
        with torch.autocast(affine.device.type, enabled=False):
            grid = self._base @ affine[..., :2].mT.view(batch, chunk, 1, 1, 2, 2) + affine[..., 2].view(
                batch, chunk, 1, 1, 1, 2
            )
            sampled = F.grid_sample(
                _HAND_GAIN * self.hand, grid.reshape(1, -1, width, 2), padding_mode="zeros", align_corners=False
            )
            inside = (grid.abs().amax(-1) < 1).view(batch, chunk, 1, cell, height, width)
        sampled = sampled.view(2, 4, batch, chunk, cell, height, width).movedim(1, 3)  # [2, B, C, 4, P, h, w]
        sampled = torch.lerp(sampled[0], sampled[1], opening.clamp(0, 1).view(batch, chunk, 1, 1, 1, 1))
        colour, weight = sampled[:, :, :3], sampled[:, :, 3:].masked_fill(~inside, -8.0)
        return torch.cat([colour, weight], 2)

    def move(self, image: Tensor, motion: Tensor) -> Tensor:
        """``image`` [B, 3, H, W] moved by pixels [B, C, P or 1, h or 1, w or 1, 2]: cells [B, C, 3, P, h, w]."""
        (batch, chunk), (cell, height, width, _) = motion.shape[:2], self._base.shape
        with torch.autocast(image.device.type, enabled=False):
            grid = torch.sub(self._base, motion.float(), alpha=2 / image.shape[-1])
            # One call for the whole chunk, sampled in the order of the cells.
            grid = grid.reshape(batch, chunk * cell * height, width, 2)
            moved = F.grid_sample(image, grid, padding_mode="border", align_corners=False)
        return moved.view(batch, 3, chunk, cell, height, width).transpose(1, 2)
