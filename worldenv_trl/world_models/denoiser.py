"""x-prediction network of the video world model: paints a chunk of frames by moving, keeping and repainting pixels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["Denoiser", "from_cells", "to_cells"]

_CANDIDATES = 5  # last frame, first frame, moved last frame, painted, hand
_HAND_TEXELS = (40, 36)  # about the image's resolution for a hand 0.3 m long
_HAND_GAIN = 25.0  # the texture has much further to travel than a weight of the network


def to_cells(images: Tensor, patch: int) -> Tensor:
    """[*B, H, W] -> [*B, patch^2, H / patch, W / patch]: the pixels of a cell side by side, row by row."""
    cells = images.unflatten(-1, (-1, patch)).unflatten(-3, (-1, patch))  # [*B, h, p, w, p]
    return cells.movedim((-3, -1), (-4, -3)).contiguous().flatten(-4, -3)


def from_cells(cells: Tensor, patch: int) -> Tensor:
    """[*B, patch^2, h, w] -> [*B, h * patch, w * patch], the inverse of :func:`to_cells`."""
    images = cells.unflatten(-3, (patch, patch)).movedim((-4, -3), (-3, -1))  # [*B, h, p, w, p]
    return images.contiguous().flatten(-4, -3).flatten(-2, -1)


class Denoiser(nn.Module):
    """Predicts the clean chunk x_0 from a noisy one, the remembered frames and the hand's path.

    A small UNet over the whole chunk works at ``1 / patch`` of the resolution. Every frame passes through one shared
    encoder before it and one shared decoder after it, so that the trunk alone pays for time. The encoder sees where
    every cell lies relative to the tool and is modulated by the frame's pose: an implicit image of the arm, whose looks
    depend on its pose alone. For every pixel of every frame the decoder chooses, by a softmax, between

    - the last frame (a static pixel is an exact copy: free and sharp),
    - the first frame (what the arm uncovers),
    - the last frame moved along with the tool's motion on the image plus a predicted residual flow (the arm, and what
      it holds or pushes, stay sharp instead of being painted again in every chunk),
    - freely painted colour,
    - the hand: a learned texture on a plane that the tool carries, shown where projection puts it (one texture for open
      fingers, one for closed). It stays sharp because all frames of all episodes share it.

    Chunks are handled as cells [B, C, 3, P, h, w], P = patch^2 (:func:`to_cells`), the layout of the finest grid:
    nothing is reordered between network, composition and loss.

    Poses, actions, noise level and the reference frame's embedding modulate the residual blocks (FiLM).

    Args:
        chunk_length: C, frames per call.
        memory_frames: M, remembered frames, oldest first; index 0 is the first frame of the video, M - 1 the last.
        image_size: side in pixels.
        patch: pixels per cell of the network's finest grid.
        map_channels: channels of the action maps, drawn on the finest grid.
        pose_dim: size of the pose of a frame.
        condition_dim: size of the vector condition of the chunk.
        width: channels of the finest level.
        multipliers: channels of every level, in units of ``width``.
        blocks: residual blocks of every level, on the way down and again on the way up.
        frame_channels: channels of the per-frame encoder.
        embedding_dim: size of the modulation embedding.
    """

    def __init__(
        self,
        *,
        chunk_length: int,
        memory_frames: int,
        image_size: int,
        patch: int,
        map_channels: int,
        pose_dim: int,
        condition_dim: int,
        width: int,
        multipliers: tuple[int, ...],
        blocks: tuple[int, ...],
        frame_channels: int,
        embedding_dim: int,
    ) -> None:
        super().__init__()
        self.chunk_length, self.patch = chunk_length, patch
        cell = 3 * patch**2
        maps = map_channels
        widths = [width * factor for factor in multipliers]

        self.condition = nn.Sequential(nn.Linear(condition_dim, embedding_dim), nn.SiLU())
        self.reference = _ReferenceEncoder(image_size, embedding_dim)
        self.noise_level = nn.Linear(1, embedding_dim)
        self.embed = nn.Sequential(nn.Linear(embedding_dim, embedding_dim), nn.SiLU())

        self.memory_in = nn.Conv2d(memory_frames * (cell + maps), width, 3, padding=1)
        self.frame_in = nn.Conv2d(cell + maps, frame_channels, 3, padding=1)
        self.frame_mid = nn.Conv2d(frame_channels, frame_channels, 3, padding=1)
        self.pose = nn.Sequential(nn.Linear(pose_dim, 64), nn.SiLU(), nn.Linear(64, 4 * frame_channels))
        self.noisy_in = nn.Conv2d(cell, frame_channels, 3, padding=1, bias=False)
        self.merge = nn.Conv2d(chunk_length * frame_channels, width, 1)

        self.down, self.shrink = nn.ModuleList(), nn.ModuleList()
        self.up, self.grow = nn.ModuleList(), nn.ModuleList()
        for level, (channels, count) in enumerate(zip(widths, blocks, strict=True)):
            self.down.append(nn.ModuleList(_Block(channels, embedding_dim) for _ in range(count)))
            if level + 1 < len(widths):
                self.shrink.append(nn.Conv2d(channels, widths[level + 1], 3, stride=2, padding=1))
                self.up.append(nn.ModuleList(_Block(channels, embedding_dim) for _ in range(count)))
                self.grow.append(nn.Conv2d(widths[level + 1], channels, 1))

        decoder = 3 * frame_channels // 2
        self.split = nn.Conv2d(width, chunk_length * decoder, 1)
        self.frame_out = nn.Conv2d(decoder + frame_channels, 2 * frame_channels, 3, padding=1)
        self.paint = nn.Conv2d(2 * frame_channels, (_CANDIDATES + 3 + 2) * patch**2, 1)  # weights, colour, flow
        nn.init.zeros_(self.paint.weight)
        with torch.no_grad():
            self.paint.bias.zero_()
            self.paint.bias[: patch**2] = 2.0  # starts as a copy of the last frame

        self.hand = nn.Parameter(torch.zeros(1, 2 * 4, *_HAND_TEXELS))  # closed and open: colour, weight
        axis = (torch.arange(image_size, dtype=torch.float32) + 0.5) * 2 / image_size - 1
        base = torch.stack([to_cells(plane, patch) for plane in torch.meshgrid(axis, axis, indexing="xy")], -1)
        self.register_buffer("_base", base, persistent=False)  # where every pixel is: [P, h, w, 2]

    def forward(
        self,
        noisy: Tensor | None,
        noise_level: Tensor,
        memory: Tensor,
        memory_maps: Tensor,
        maps: Tensor,
        motion: Tensor,
        hand: Tensor,
        opening: Tensor,
        poses: Tensor,
        condition: Tensor,
        reference: Tensor,
        frames: Tensor | None = None,
    ) -> Tensor:
        """Images are float in [-1, 1].

        Args:
            noisy: [B, C, 3, P, h, w], the noisy chunk, or None for zeros (which cost nothing).
            noise_level: [B], 0 is pure noise (or nothing known), 1 is clean.
            memory: [B, M, 3, H, W].
            memory_maps: [B, M, K, h, w], action maps and tool coordinates of the remembered frames.
            maps: [B, C, K, h, w], the same of the frames to paint.
            motion: [B, C, 2], the tool's motion on the image since the last frame, in pixels.
            hand: [B, C, 2, 3], affine map from the image's coordinates to those of the hand's texture, both in [-1, 1].
            opening: [B, C], of the gripper.
            poses: [B, C, D'], the pose of every frame to paint.
            condition: [B, D], poses and actions of the whole chunk.
            reference: [B, 3, H, W].
            frames: int64 [F], which frames of the chunk to paint, or None for all. The trunk always sees the whole
                chunk; leaving frames out saves the decoder's share.

        Returns:
            x_0 float32 [B, C or F, 3, P, h, w].
        """
        batch, chunk = motion.shape[:2]
        embedding = self.condition(condition) + self.reference(reference) + self.noise_level(noise_level.unsqueeze(-1))
        embedding = self.embed(embedding)
        motion = motion.view(batch, chunk, 1, 1, 1, 2)
        remembered = to_cells(memory, self.patch)  # [B, M, 3, P, h, w]

        with torch.no_grad():
            moved = self._move(memory[:, -1], motion).flatten(2, 3)
            per_frame = torch.cat([moved, maps], 2).flatten(0, 1).contiguous(memory_format=torch.channels_last)
        per_frame = self.frame_in(per_frame)
        if noisy is not None:
            noisy = noisy.flatten(2, 3).flatten(0, 1).contiguous(memory_format=torch.channels_last)
            per_frame = per_frame + self.noisy_in(noisy)
        modulation = self.pose(poses.flatten(0, 1))[..., None, None].chunk(4, 1)
        per_frame = F.silu(torch.addcmul(modulation[0], per_frame, 1 + modulation[1]))
        per_frame = F.silu(torch.addcmul(modulation[2], self.frame_mid(per_frame), 1 + modulation[3]))
        inputs = torch.cat([remembered.flatten(2, 3), memory_maps], 2).flatten(1, 2)
        trunk = self.memory_in(inputs.contiguous(memory_format=torch.channels_last))
        trunk = trunk + self.merge(_frames_to_channels(per_frame, chunk))

        skips = []
        for level, blocks in enumerate(self.down):
            for block in blocks:
                trunk = block(trunk, embedding)
            if level < len(self.shrink):
                skips.append(trunk)
                trunk = self.shrink[level](trunk)
        for level in reversed(range(len(self.up))):
            trunk = skips[level] + F.interpolate(self.grow[level](trunk), scale_factor=2, mode="nearest")
            for block in self.up[level]:
                trunk = block(trunk, embedding)

        decoded = _channels_to_frames(F.silu(self.split(trunk)), chunk)
        if frames is not None:
            every = (torch.arange(batch, device=frames.device).unsqueeze(-1) * chunk + frames).flatten()
            decoded, per_frame, motion = decoded[every], per_frame[every], motion[:, frames]
            hand, opening = hand[:, frames], opening[:, frames]
        decoded = F.silu(self.frame_out(torch.cat([decoded, per_frame], 1)))
        painted = self.paint(decoded).float().contiguous().unflatten(1, (-1, self.patch**2))
        painted = painted.unflatten(0, (batch, motion.shape[1]))
        sprite = self._hand(hand, opening)  # [B, C, 4, P, h, w]
        weight = torch.cat(
            [painted[:, :, : _CANDIDATES - 1], painted[:, :, _CANDIDATES - 1 : _CANDIDATES] + sprite[:, :, 3:]], 2
        )
        weight = weight.softmax(2).unsqueeze(3)  # [B, C, 5, 1, P, h, w]
        colour, flow = painted[:, :, _CANDIDATES : _CANDIDATES + 3], painted[:, :, _CANDIDATES + 3 :]
        moved = self._move(memory[:, -1], motion + flow.movedim(2, -1))
        chosen = weight[:, :, 0] * remembered[:, None, -1]
        chosen = torch.addcmul(chosen, weight[:, :, 1], remembered[:, None, 0])
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

    def _move(self, image: Tensor, motion: Tensor) -> Tensor:
        """``image`` [B, 3, H, W] moved by pixels [B, C, P or 1, h or 1, w or 1, 2]: cells [B, C, 3, P, h, w]."""
        (batch, chunk), (cell, height, width, _) = motion.shape[:2], self._base.shape
        with torch.autocast(image.device.type, enabled=False):
            grid = torch.sub(self._base, motion.float(), alpha=2 / image.shape[-1])
            # One call for the whole chunk, sampled in the order of the cells.
            grid = grid.reshape(batch, chunk * cell * height, width, 2)
            moved = F.grid_sample(image, grid, padding_mode="border", align_corners=False)
        return moved.view(batch, 3, chunk, cell, height, width).transpose(1, 2)


def _frames_to_channels(features: Tensor, chunk: int) -> Tensor:
    """[B C, D, h, w] -> [B, C D, h, w], both channels_last."""
    features = features.permute(0, 2, 3, 1).unflatten(0, (-1, chunk))  # [B, C, h, w, D]
    return features.permute(0, 2, 3, 1, 4).flatten(3).permute(0, 3, 1, 2)


def _channels_to_frames(features: Tensor, chunk: int) -> Tensor:
    """The inverse of :func:`_frames_to_channels`."""
    features = features.permute(0, 2, 3, 1).unflatten(3, (chunk, -1))  # [B, h, w, C, D]
    return features.permute(0, 3, 1, 2, 4).flatten(0, 1).permute(0, 3, 1, 2)


class _Block(nn.Module):
    """Residual block with feature-wise modulation."""

    def __init__(self, channels: int, embedding_dim: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.modulation = nn.Linear(embedding_dim, 2 * channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, features: Tensor, embedding: Tensor) -> Tensor:
        scale, shift = self.modulation(embedding)[..., None, None].chunk(2, 1)
        hidden = self.first(self.norm(features))
        return features + self.second(F.silu(torch.addcmul(shift, hidden, 1 + scale)))


class _ReferenceEncoder(nn.Module):
    """Embedding [B, D] of the reference frame, at a quarter of the resolution."""

    def __init__(self, image_size: int, embedding_dim: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.AvgPool2d(4), nn.Conv2d(3, 32, 3, 2, 1), nn.SiLU(), nn.Conv2d(32, 32, 3, 2, 1), nn.SiLU(), nn.Flatten()
        )
        self.project = nn.Linear(32 * (image_size // 16) ** 2, embedding_dim)

    def forward(self, image: Tensor) -> Tensor:
        return self.project(self.convolutions(image))
