"""x-prediction network of the video world model: paints a chunk of frames of every camera in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from worldenv_trl.world_models.cells import to_cells
from worldenv_trl.world_models.painter import Painter

__all__ = ["Denoiser", "View"]


@dataclass(frozen=True)
class View:
    """What the network is told of one camera. Images are float in [-1, 1]."""

    memory: Tensor
    """[B, M, 3, H, W], remembered frames, oldest first; 0 is the first frame of the video, M - 1 the last."""
    memory_maps: Tensor
    """[B, M, K, h, w], action maps and tool coordinates of the remembered frames."""
    maps: Tensor
    """[B, C, K, h, w], the same of the frames to paint."""
    motion: Tensor
    """[B, C, 2], of the tool on the image since the last frame, in pixels."""
    hand: Tensor
    """[B, C, 2, 3], affine map from the image's coordinates to those of the hand's texture, both in [-1, 1]."""
    reference: Tensor
    """[B, 3, H, W]."""


class Denoiser(nn.Module):
    """Predicts the clean chunk x_0 from a noisy one, the remembered frames and the hand's path.

    A small UNet over the whole chunk and all cameras works at ``1 / patch`` of the resolution. Every frame passes
    through one encoder of its camera before it and one painter after it (:class:`Painter`), so that the trunk alone
    pays for time. The encoder sees where every cell lies relative to the tool and is modulated by the frame's pose: an
    implicit image of the arm, whose looks depend on its pose alone.

    Chunks are handled as cells [B, V, C, 3, P, h, w], V cameras, P = patch^2 (:func:`to_cells`).

    Poses, actions, noise level and the reference frame's embedding modulate the residual blocks (FiLM).

    Args:
        views: V, cameras.
        chunk_length: C, frames per call.
        memory_frames: M.
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
        views: int = 1,
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
        cell, maps = 3 * patch**2, map_channels
        widths = [width * factor for factor in multipliers]

        self.condition = nn.Sequential(nn.Linear(condition_dim, embedding_dim), nn.SiLU())
        self.reference = nn.ModuleList(_ReferenceEncoder(image_size, embedding_dim) for _ in range(views))
        self.noise_level = nn.Linear(1, embedding_dim)
        self.embed = nn.Sequential(nn.Linear(embedding_dim, embedding_dim), nn.SiLU())

        self.memory_in = nn.Conv2d(views * memory_frames * (cell + maps), width, 3, padding=1)
        self.encoders = nn.ModuleList(_FrameEncoder(cell, maps, frame_channels, pose_dim) for _ in range(views))
        self.merge = nn.Conv2d(views * chunk_length * frame_channels, width, 1)

        self.down, self.shrink = nn.ModuleList(), nn.ModuleList()
        self.up, self.grow = nn.ModuleList(), nn.ModuleList()
        for level, (channels, count) in enumerate(zip(widths, blocks, strict=True)):
            self.down.append(nn.ModuleList(_Block(channels, embedding_dim) for _ in range(count)))
            if level + 1 < len(widths):
                self.shrink.append(nn.Conv2d(channels, widths[level + 1], 3, stride=2, padding=1))
                self.up.append(nn.ModuleList(_Block(channels, embedding_dim) for _ in range(count)))
                self.grow.append(nn.Conv2d(widths[level + 1], channels, 1))

        decoder = 3 * frame_channels // 2
        self.split = nn.Conv2d(width, views * chunk_length * decoder, 1)
        self.painters = nn.ModuleList(
            Painter(image_size, patch, decoder + frame_channels, 2 * frame_channels) for _ in range(views)
        )

    def forward(
        self,
        noisy: Tensor | None,
        noise_level: Tensor,
        views: Sequence[View],
        opening: Tensor,
        poses: Tensor,
        condition: Tensor,
    ) -> Tensor:
        """x_0 float32 [B, V, C, 3, P, h, w].

        Args:
            noisy: [B, V, C, 3, P, h, w], the noisy chunk, or None for zeros (which cost nothing).
            noise_level: [B], 0 is pure noise (or nothing known), 1 is clean.
            views: V of them.
            opening: [B, C], of the gripper.
            poses: [B, C, D'], the pose of every frame to paint.
            condition: [B, D], poses and actions of the whole chunk.
        """
        chunk = self.chunk_length
        embedding = self.condition(condition)
        for view, encode in zip(views, self.reference, strict=True):
            embedding = embedding + encode(view.reference)
        embedding = self.embed(embedding + self.noise_level(noise_level.unsqueeze(-1)))

        encoded = [
            encode(view, painter, None if noisy is None else noisy[:, index], poses)
            for index, (view, encode, painter) in enumerate(zip(views, self.encoders, self.painters, strict=True))
        ]  # each [B C, D, h, w]
        remembered = [
            torch.cat([to_cells(view.memory, self.patch).flatten(2, 3), view.memory_maps], 2).flatten(1, 2)
            for view in views
        ]
        trunk = self.memory_in(_joined(remembered).contiguous(memory_format=torch.channels_last))
        trunk = trunk + self.merge(_joined([_frames_to_channels(frames, chunk) for frames in encoded]))
        trunk = self._trunk(trunk, embedding)

        decoded = F.silu(self.split(trunk)).chunk(len(views), 1)
        painted = [
            paint(
                torch.cat([_channels_to_frames(part, chunk), frames], 1), view.memory, view.motion, view.hand, opening
            )
            for part, frames, view, paint in zip(decoded, encoded, views, self.painters, strict=True)
        ]
        return painted[0].unsqueeze(1) if len(painted) == 1 else torch.stack(painted, 1)

    def _trunk(self, trunk: Tensor, embedding: Tensor) -> Tensor:
        skips = []
        for level, blocks in enumerate(self.down):
            for block in blocks:  # type: ignore[attr-defined] # a ModuleList in a ModuleList
                trunk = block(trunk, embedding)
            if level < len(self.shrink):
                skips.append(trunk)
                trunk = self.shrink[level](trunk)
        for level in reversed(range(len(self.up))):
            trunk = skips[level] + F.interpolate(self.grow[level](trunk), scale_factor=2, mode="nearest")
            for block in self.up[level]:  # type: ignore[attr-defined] # the same
                trunk = block(trunk, embedding)
        return trunk


def _joined(parts: list[Tensor]) -> Tensor:
    """Channels side by side; a single part is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def _frames_to_channels(features: Tensor, chunk: int) -> Tensor:
    """[B C, D, h, w] -> [B, C D, h, w], both channels_last."""
    features = features.permute(0, 2, 3, 1).unflatten(0, (-1, chunk))  # [B, C, h, w, D]
    return features.permute(0, 2, 3, 1, 4).flatten(3).permute(0, 3, 1, 2)


def _channels_to_frames(features: Tensor, chunk: int) -> Tensor:
    """The inverse of :func:`_frames_to_channels`."""
    features = features.permute(0, 2, 3, 1).unflatten(3, (chunk, -1))  # [B, h, w, C, D]
    return features.permute(0, 3, 1, 2, 4).flatten(0, 1).permute(0, 3, 1, 2)


class _FrameEncoder(nn.Module):
    """Features [B C, D, h, w] of the frames to paint: the moved last frame, the maps, the pose, the noise."""

    def __init__(self, cell: int, maps: int, channels: int, pose_dim: int) -> None:
        super().__init__()
        self.frame_in = nn.Conv2d(cell + maps, channels, 3, padding=1)
        self.frame_mid = nn.Conv2d(channels, channels, 3, padding=1)
        self.pose = nn.Sequential(nn.Linear(pose_dim, 64), nn.SiLU(), nn.Linear(64, 4 * channels))
        self.noisy_in = nn.Conv2d(cell, channels, 3, padding=1, bias=False)

    def forward(self, view: View, painter: Painter, noisy: Tensor | None, poses: Tensor) -> Tensor:
        batch, chunk = view.motion.shape[:2]
        with torch.no_grad():
            moved = painter.move(view.memory[:, -1], view.motion.view(batch, chunk, 1, 1, 1, 2)).flatten(2, 3)
            inputs = torch.cat([moved, view.maps], 2).flatten(0, 1).contiguous(memory_format=torch.channels_last)
        features = self.frame_in(inputs)
        if noisy is not None:
            noisy = noisy.flatten(2, 3).flatten(0, 1).contiguous(memory_format=torch.channels_last)
            features = features + self.noisy_in(noisy)
        modulation = self.pose(poses.flatten(0, 1))[..., None, None].chunk(4, 1)
        features = F.silu(torch.addcmul(modulation[0], features, 1 + modulation[1]))
        return F.silu(torch.addcmul(modulation[2], self.frame_mid(features), 1 + modulation[3]))


class _Block(nn.Module):
    """Residual block with feature-wise modulation."""

    def __init__(self, channels: int, embedding_dim: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.modulation = nn.Linear(embedding_dim, 2 * channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

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
