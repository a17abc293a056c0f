"""The video world model: frames of a chunk from remembered frames and the hand's predicted path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from worldenv_trl.keys import CHUNK_LENGTH, FRAMES, POSE_DIM, TASK_ID
from worldenv_trl.kinematics import ActionMap
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.world_models.denoiser import Denoiser, from_cells, to_cells
from worldenv_trl.world_models.flow_matching import sample, seeded_noise

__all__ = ["VideoWorldModel", "VideoWorldModelConfig"]

MEMORY_FRAMES = ("memory", "frames")  # uint8 [B, M, 3, H, W]
MEMORY_POSES = ("memory", "poses")  # float32 [B, M, 13]
REFERENCE = ("memory", "reference")  # uint8 [B, 3, H, W]
POSES = "poses"  # float32 [B, C, 13], FK-predicted
PADDED_ACTIONS = "padded_actions"  # float32 [B, C, 14]: dual-arm interface, unused arm zero
NOISE_SEED = "noise_seed"  # int64 [B, 1]

PADDED_ACTION_DIM = 14
_MEMORY = 3  # first frame, the frame memory_stride back, last frame
_HAND_CENTRE = (0.0, -0.10)  # metres along the tool's y and z axes from the tool centre
_HAND_HALF_SIZE = (0.14, 0.16)
_POSITION_SCALE = 10.0  # metres to the unit scale of the network's other inputs


@dataclass(frozen=True)
class VideoWorldModelConfig:
    """Sizes and settings of :class:`VideoWorldModel`. Plain values: it is written to ``config.json``."""

    cameras: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Task id -> position, rotation and fovy_deg of the camera; see :meth:`for_cameras`."""
    image_size: int = 64
    chunk_length: int = CHUNK_LENGTH
    memory_stride: int = 4
    """The middle memory frame is this many frames older than the last."""
    patch: int = 4
    """Pixels per cell of the network's finest grid."""
    width: int = 96
    multipliers: tuple[int, ...] = (1, 2)
    blocks: tuple[int, ...] = (2, 2)
    frame_channels: int = 32
    embedding_dim: int = 192
    num_denoise_steps: int = 1
    deterministic: bool = True
    """One step from zero noise, whatever ``num_denoise_steps``."""
    precision: str = "auto"
    """``float32``, ``bfloat16`` (autocast) or ``auto``: bfloat16 where there is hardware for it (GPU, CPU with AMX). On
    a CPU without AMX bfloat16 convolutions take 1.8 times as long as float32 ones."""
    rows_per_call: int = 16
    """Rows that pass through the network at once at inference; keeps activations inside the CPU cache."""

    def __post_init__(self) -> None:
        for name in ("multipliers", "blocks"):
            object.__setattr__(self, name, tuple(int(value) for value in getattr(self, name)))
        if len(self.multipliers) != len(self.blocks) or not self.blocks:
            raise ValueError(f"multipliers and blocks must be equally long, got {self.multipliers} and {self.blocks}")
        grid = self.patch * 2 ** (len(self.blocks) - 1)
        if self.image_size < 32 or self.image_size % max(16, grid):
            raise ValueError(
                f"image_size must be a multiple of {max(16, grid)} and at least 32 px, got {self.image_size}"
            )
        if not 1 <= self.memory_stride <= self.chunk_length:
            raise ValueError(
                f"memory_stride must lie between 1 and chunk_length={self.chunk_length}, got {self.memory_stride}"
            )
        if self.precision not in ("auto", "float32", "bfloat16"):
            raise ValueError(f"precision must be auto, float32 or bfloat16, got {self.precision!r}")
        if not 1 <= self.num_denoise_steps <= 4:
            raise ValueError(f"num_denoise_steps must lie between 1 and 4, got {self.num_denoise_steps}")
        if any(self.width * factor % 8 for factor in self.multipliers):
            raise ValueError(f"width times every multiplier must be a multiple of 8, got {self.width}")

    @classmethod
    def for_cameras(cls, cameras: Mapping[int, Any], **settings) -> VideoWorldModelConfig:
        """Config for the tasks whose ids map to a :class:`worldenv_trl.scenes.camera.Camera` each."""
        plain = {
            str(int(task_id)): {
                "position": tuple(float(value) for value in camera.position),
                "rotation": tuple(tuple(float(value) for value in row) for row in camera.rotation),
                "fovy_deg": float(getattr(camera, "fovy_deg", getattr(camera, "fovy", 45.0))),
            }
            for task_id, camera in cameras.items()
        }
        return cls(cameras=plain, **settings)


class VideoWorldModel(TensorDictModuleBase, Pretrained):
    """Action-conditioned video, one chunk of C frames a call (World-Env section 3.2, after EnerVerse-AC).

    Conditions: frame memory (the first frame, one ``memory_stride`` back and the last), action maps of the FK-predicted
    poses, those poses and the 14-D padded actions as a vector, and an embedding of the reference frame by modulation.

    Reads (B rows): ``("memory", "frames")`` uint8 [B, M, 3, H, W], ``("memory", "poses")`` [B, M, 13],
    ``("memory", "reference")`` uint8 [B, 3, H, W], ``poses`` [B, C, 13] (position m, rotation row-major, opening),
    ``padded_actions`` [B, C, 14], ``task_id`` [B, 1] and, if present, ``noise_seed`` int64 [B, 1].
    Writes ``frames`` uint8 [B, C, 3, H, W].

    Args:
        config: sizes, cameras and sampling settings.

    ``deterministic`` and ``num_denoise_steps`` may be changed on the module at any time. With ``deterministic`` the
    chunk is predicted in one step from zero noise; otherwise noise is drawn per row from ``noise_seed`` (from torch's
    generator when absent) and removed in ``num_denoise_steps`` steps.

    Raises:
        ValueError: missing cameras, frames of another size or dtype, a chunk of another length.
    """

    config_class = VideoWorldModelConfig

    def __init__(self, config: VideoWorldModelConfig) -> None:
        super().__init__()
        if not config.cameras:
            raise ValueError(
                "cameras is empty: build the config with VideoWorldModelConfig.for_cameras({task_id: camera})"
            )
        self.config = config
        self.in_keys = [MEMORY_FRAMES, MEMORY_POSES, REFERENCE, POSES, PADDED_ACTIONS, TASK_ID]
        self.out_keys = [FRAMES]
        self.deterministic, self.num_denoise_steps = config.deterministic, config.num_denoise_steps
        cameras = {int(task_id): SimpleNamespace(**camera) for task_id, camera in config.cameras.items()}
        self.action_map = ActionMap(cameras, config.image_size // config.patch)
        chunk = config.chunk_length
        self.denoiser = Denoiser(
            chunk_length=chunk,
            memory_frames=_MEMORY,
            image_size=config.image_size,
            patch=config.patch,
            map_channels=ActionMap.channels + 4,
            pose_dim=POSE_DIM + 3,
            condition_dim=(_MEMORY + chunk) * (POSE_DIM + 3) + chunk * PADDED_ACTION_DIM,
            width=config.width,
            multipliers=config.multipliers,
            blocks=config.blocks,
            frame_channels=config.frame_channels,
            embedding_dim=config.embedding_dim,
        ).to(memory_format=torch.channels_last)

    @property
    def chunk_length(self) -> int:
        return self.config.chunk_length

    @property
    def image_size(self) -> int:
        return self.config.image_size

    @property
    def memory_frames(self) -> int:
        """M."""
        return _MEMORY

    def memory_indices(self, t: Tensor) -> Tensor:
        """Which frames of the video o_0..o_t are remembered: int64 [B] -> [B, M], newest last."""
        return torch.stack([torch.zeros_like(t), (t - self.config.memory_stride).clamp(min=0), t], -1)

    def next_memory(self, memory: Tensor, chunk: Tensor) -> Tensor:
        """The memory one chunk later: [B, M, ...] and the chunk's [B, C, ...] -> [B, M, ...]."""
        stride = self.config.memory_stride
        middle = chunk[:, -1 - stride] if stride < chunk.shape[1] else memory[:, -1]
        return torch.stack([memory[:, 0], middle, chunk[:, -1]], 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check(tensordict)
        size = self.config.image_size
        if tensordict.shape[0] == 0:
            empty = torch.zeros(0, self.chunk_length, 3, size, size, dtype=torch.uint8, device=tensordict[POSES].device)
            return tensordict.set(FRAMES, empty)
        with torch.no_grad():
            parts = [self._generate(part) for part in tensordict.split(self.config.rows_per_call)]
        return tensordict.set(FRAMES, torch.cat(parts))

    def _generate(self, tensordict: TensorDictBase) -> Tensor:
        size, rows, patch = self.config.image_size, tensordict.shape[0], self.config.patch
        conditions, device = self.conditions(tensordict), tensordict[POSES].device
        if self.deterministic:
            clean = self.predict(None, torch.zeros(rows, device=device), conditions)
        else:
            seed, shape = tensordict.get(NOISE_SEED, None), (self.chunk_length, 3, size, size)
            noise = torch.randn(rows, *shape, device=device) if seed is None else seeded_noise(seed, shape)
            noise = to_cells(noise, patch)
            clean = sample(lambda x, level: self.predict(x, level, conditions), noise, self.num_denoise_steps)
        return to_uint8(from_cells(clean, patch))

    def conditions(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """What the denoiser knows besides the noisy chunk: its keyword arguments, computed once for all steps."""
        memory_poses, poses = tensordict[MEMORY_POSES].float(), tensordict[POSES].float()
        task_id = tensordict[TASK_ID]
        every = torch.cat([memory_poses, poses], 1)  # [B, M + C, 13]
        with torch.no_grad():
            pixels = self.action_map.project(every[..., :3], task_id)  # cells of the finest grid
            maps = torch.cat([self.action_map(every, task_id), self._tool_coordinates(pixels)], 2)
        motion = (pixels[:, _MEMORY:] - pixels[:, _MEMORY - 1 : _MEMORY]) * self.config.patch
        vectors = self._pose_vectors(every)
        return {
            "memory": to_float(tensordict[MEMORY_FRAMES]),
            "memory_maps": maps[:, :_MEMORY],
            "maps": maps[:, _MEMORY:],
            "motion": motion.clamp(-self.config.image_size, self.config.image_size),
            "hand": self._hand_plane(poses, pixels[:, _MEMORY:], task_id),
            "opening": poses[..., 12],
            "poses": vectors[:, _MEMORY:],
            "condition": torch.cat([vectors.flatten(1), tensordict[PADDED_ACTIONS].float().flatten(1)], -1),
            "reference": to_float(tensordict[REFERENCE]),
        }

    def predict(
        self, noisy: Tensor | None, level: Tensor, conditions: dict[str, Tensor], frames: Tensor | None = None
    ) -> Tensor:
        """x_0 from the noisy chunk (None: zeros) at noise level [B] (0: pure noise or zeros).

        Both are float cells [B, C, 3, patch^2, h, w] of images in [-1, 1], see :func:`to_cells`. ``frames`` int64 [F]
        asks for some frames of the chunk only.
        """
        with torch.autocast(level.device.type, torch.bfloat16, enabled=self._bfloat16(level.device)):
            return self.denoiser(noisy, level, **conditions, frames=frames)

    def _bfloat16(self, device: torch.device) -> bool:
        if self.config.precision == "auto":
            return device.type != "cpu" or torch.cpu._is_amx_tile_supported()
        return self.config.precision == "bfloat16"

    def _tool_coordinates(self, pixels: Tensor) -> Tensor:
        """Every cell's offset from the tool, saturating far and, once more, near it: [*B, 2] -> [*B, 4, h, w]."""
        side = self.action_map.height
        axis = torch.arange(side, device=pixels.device, dtype=torch.float32) + 0.5
        offset = (axis - pixels.unsqueeze(-1)) / side  # [*B, 2, side]
        offset = torch.cat([torch.tanh(3 * offset), torch.tanh(12 * offset)], -2)
        across = offset[..., ::2, None, :].expand(*pixels.shape[:-1], 2, side, side)
        down = offset[..., 1::2, :, None].expand(*pixels.shape[:-1], 2, side, side)
        return torch.cat([across, down], -3)

    @torch.no_grad()
    def _hand_plane(self, poses: Tensor, origin: Tensor, task_id: Tensor) -> Tensor:
        """Image coordinates -> coordinates on the plane of the tool's y and z axes (affine): [B, C, 2, 3].

        Args:
            poses: [B, C, 13].
            origin: [B, C, 2], the projected tool centre in cells.
            task_id: [B, 1].
        """
        side, reach = self.action_map.height, 0.05
        axes = poses[..., 3:12].unflatten(-1, (3, 3)).mT[..., 1:, :]  # [B, C, axis y or z, 3]
        ends = torch.stack(
            [self.action_map.project(poses[..., :3] + reach * axes[..., i, :], task_id) for i in (0, 1)], -1
        )
        # Image coordinates in [-1, 1] per metre along y and z: [B, C, 2, 2].
        jacobian = (ends - origin.unsqueeze(-1)) * (2 / side / reach)
        (a, b), (c, d) = (row.unbind(-1) for row in jacobian.unbind(-2))
        # A plane seen edge-on would be sampled infinitely wide.
        det = a * d - b * c
        least = 0.1 * (b.square() + d.square()) + 1e-2
        det = torch.where(det < 0, -1.0, 1.0) * det.abs().clamp(min=least)
        inverse = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2) / det[..., None, None]
        half = inverse.new_tensor(_HAND_HALF_SIZE).unsqueeze(-1)
        matrix = inverse / half
        centre = origin * (2 / side) - 1
        offset = -(matrix @ centre.unsqueeze(-1)) - inverse.new_tensor(_HAND_CENTRE).unsqueeze(-1) / half
        return torch.cat([matrix, offset], -1)

    @staticmethod
    def _pose_vectors(poses: Tensor) -> Tensor:
        """Position since the last remembered frame, position, rotation, opening: [B, M + C, 13] -> [B, M + C, 16]."""
        position = poses[..., :3] * _POSITION_SCALE
        origin = position[:, _MEMORY - 1 : _MEMORY]
        return torch.cat([position - origin, 0.3 * position, poses[..., 3:]], -1)

    def _check(self, tensordict: TensorDictBase) -> None:
        size, chunk = self.config.image_size, self.chunk_length
        frames = tensordict[MEMORY_FRAMES]
        if frames.dtype != torch.uint8 or tuple(frames.shape[1:]) != (_MEMORY, 3, size, size):
            raise ValueError(
                f"{MEMORY_FRAMES} must be uint8 [B, {_MEMORY}, 3, {size}, {size}], "
                f"got {frames.dtype} {tuple(frames.shape)}"
            )
        for key, width in ((POSES, POSE_DIM), (PADDED_ACTIONS, PADDED_ACTION_DIM)):
            if tuple(tensordict[key].shape[1:]) != (chunk, width):
                raise ValueError(f"{key} must be [B, {chunk}, {width}], got {tuple(tensordict[key].shape)}")


def to_float(images: Tensor) -> Tensor:
    """uint8 images -> float in [-1, 1]."""
    return images.float() * (2 / 255) - 1


def to_uint8(images: Tensor) -> Tensor:
    """Float images in [-1, 1] -> uint8, rounded."""
    return ((images + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
