"""The video world model: frames of a chunk from remembered frames and the hand's predicted path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from worldenv_trl.keys import CHUNK_LENGTH, NOISE_SEED, POSE_DIM, frames_key
from worldenv_trl.kinematics import ActionMap
from worldenv_trl.kinematics.calibrations import Calibrations, check_instructions, plain_cameras
from worldenv_trl.language import instructions_of
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.robot.camera import Camera
from worldenv_trl.world_models.base import (
    MEMORY_POSES,
    PADDED_ACTION_DIM,
    PADDED_ACTIONS,
    POSES,
    WorldModel,
    memory_key,
    reference_key,
)
from worldenv_trl.world_models.cells import from_cells, to_cells, to_float, to_uint8
from worldenv_trl.world_models.denoiser import Denoiser, View
from worldenv_trl.world_models.flow_matching import sample, seeded_noise
from worldenv_trl.world_models.geometry import hand_plane, tool_coordinates
from worldenv_trl.world_models.video_training import video_loss

__all__ = ["VideoWorldModel", "VideoWorldModelConfig"]

_MEMORY = 3  # first frame, the frame memory_stride back, last frame
_PIXELS_AT_ONCE = 2**17  # of a frame, all rows and cameras: half of it and twice as many are slower at 128 px
_PIXELS_AT_ONCE_ON_GPU = 2**20  # 256 rows of 64 px: filled with work, and a few GB
_POSITION_SCALE = 10.0  # metres to the unit scale of the network's other inputs


@dataclass(frozen=True)
class VideoWorldModelConfig:
    """Sizes and settings of :class:`VideoWorldModel`. Plain values: it is written to ``config.json``."""

    cameras: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """Camera name -> instruction -> the :class:`~worldenv_trl.robot.camera.Camera` it is; see :meth:`for_cameras`."""
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
    rows_per_call: int | None = None
    """Rows that pass through the network at once at inference; few enough keep the activations inside a CPU's cache,
    many keep a GPU busy. None is 16 on a CPU and 256 on a GPU, or fewer of larger images."""
    unroll_prob: float = 0.5
    """In training, share of the later chunks of a window that remember the model's own frames."""
    noise_prob: float | None = None
    """In training, share of the rows at random noise levels; None is 0 for a deterministic model, else 0.5."""
    l1_weight: float = 0.15
    """In training, weight of the absolute error beside the squared one."""
    moving_weight: float = 4.0
    """In training, additional weight of moving pixels."""

    def __post_init__(self) -> None:
        for name in ("multipliers", "blocks"):
            object.__setattr__(self, name, tuple(int(value) for value in getattr(self, name)))
        if len(self.multipliers) != len(self.blocks) or not self.blocks:
            raise ValueError(f"multipliers and blocks must be equally long, got {self.multipliers} and {self.blocks}")
        if self.patch < 1:
            raise ValueError(f"patch must be at least 1 px, got {self.patch}")
        grid = self.patch * 2 ** (len(self.blocks) - 1)
        if self.image_size < 32 or self.image_size % max(16, grid):
            raise ValueError(
                f"image_size must be a multiple of {max(16, grid)} and at least 32 px, got {self.image_size}"
            )
        if self.image_size // self.patch < 16:
            raise ValueError(
                f"patch must leave at least 16 cells a side, got {self.patch} px of {self.image_size} px images"
            )
        if not 1 <= self.memory_stride <= self.chunk_length:
            raise ValueError(
                f"memory_stride must lie between 1 and chunk_length={self.chunk_length}, got {self.memory_stride}"
            )
        if self.precision not in ("auto", "float32", "bfloat16"):
            raise ValueError(f"precision must be auto, float32 or bfloat16, got {self.precision!r}")
        if not 1 <= self.num_denoise_steps <= 4:
            raise ValueError(f"num_denoise_steps must lie between 1 and 4, got {self.num_denoise_steps}")
        if self.rows_per_call is not None and self.rows_per_call < 1:
            raise ValueError(f"rows_per_call must be at least 1, got {self.rows_per_call}")
        if any(self.width * factor < 8 or self.width * factor % 8 for factor in self.multipliers):
            raise ValueError(f"width times every multiplier must be a positive multiple of 8, got {self.width}")
        for name, value in (("unroll_prob", self.unroll_prob), ("noise_prob", self.noise_prob)):
            if value is not None and not 0 <= value <= 1:
                raise ValueError(f"{name} must lie between 0 and 1, got {value}")
        if min(self.l1_weight, self.moving_weight) < 0:
            raise ValueError(
                f"l1_weight and moving_weight must not be negative, got {self.l1_weight} and {self.moving_weight}"
            )

    @classmethod
    def for_cameras(cls, cameras: Mapping[str, Mapping[str, Camera]], **settings: Any) -> VideoWorldModelConfig:
        """Config for ``{camera name: {instruction: camera}}``: what each instruction's scene is seen through."""
        return cls(cameras=plain_cameras(cameras), **settings)

    def rows_at_once(self, device: torch.device | str = "cpu") -> int:
        """:attr:`rows_per_call`, or what it is on ``device`` when that is None."""
        if self.rows_per_call is not None:
            return self.rows_per_call
        pixels = self.image_size**2 * max(1, len(self.cameras))
        if torch.device(device).type == "cpu":
            return min(16, max(1, _PIXELS_AT_ONCE // pixels))
        return max(1, _PIXELS_AT_ONCE_ON_GPU // pixels)

    @property
    def instructions(self) -> tuple[str, ...]:
        """Those that it has cameras for."""
        return tuple(next(iter(self.cameras.values()), {}))


class VideoWorldModel(WorldModel, Pretrained):
    """Action-conditioned video, one chunk of C frames a call (World-Env section 3.2, after EnerVerse-AC).

    Conditions: frame memory (the first frame, one ``memory_stride`` back and the last), action maps of the FK-predicted
    poses, those poses and the 14-D padded actions as a vector, and an embedding of the reference frame by modulation.
    All cameras are painted in one pass. A camera on the hand moves with it: where the hand goes is drawn as the camera
    saw it last, and what it sees moves the other way.

    Reads a :func:`~worldenv_trl.world_models.request` and writes ``("frames", entry)`` uint8 [B, C, 3, H, W] of each
    camera. The instruction says which calibration holds; one that it was not trained on gets the commonest.

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
        check_instructions(config.cameras, "VideoWorldModelConfig")
        super().__init__(
            cameras=tuple(config.cameras),
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            instructions=config.instructions,
        )
        self.config = config
        self.deterministic, self.num_denoise_steps = config.deterministic, config.num_denoise_steps
        self._views = [Calibrations(by_text) for by_text in config.cameras.values()]
        side = config.image_size // config.patch
        self.action_maps = torch.nn.ModuleList(ActionMap(view.distinct, side) for view in self._views)
        chunk = config.chunk_length
        self.denoiser = Denoiser(  # type: ignore[call-overload] # PyTorch does not declare memory_format
            views=len(self.cameras),
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

    def memory_indices(self, now: Tensor) -> Tensor:
        """The first frame, the one ``memory_stride`` back and the last: int64 [B] -> [B, 3]."""
        return torch.stack([torch.zeros_like(now), (now - self.config.memory_stride).clamp(min=0), now], -1)

    def training_loss(self, windows: TensorDictBase) -> TensorDict:
        """See :func:`~worldenv_trl.world_models.video_training.video_loss`."""
        return video_loss(self, windows)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check(tensordict)
        texts, rows = instructions_of(tensordict), self.config.rows_at_once(tensordict[POSES].device)
        shape, device = (len(texts), self.chunk_length, 3, self.image_size, self.image_size), tensordict[POSES].device
        frames = {camera: torch.empty(shape, dtype=torch.uint8, device=device) for camera in self.cameras}
        with torch.no_grad():
            for start in range(0, len(texts), rows):
                painted = self._generate(tensordict[start : start + rows], texts[start : start + rows])
                for camera, video in zip(self.cameras, painted.unbind(1), strict=True):
                    frames[camera][start : start + rows] = video
        for camera, video in frames.items():
            tensordict.set(frames_key(camera), video)
        return tensordict

    def _generate(self, tensordict: TensorDictBase, texts: Sequence[str]) -> Tensor:
        """uint8 [B, V, C, 3, H, W]."""
        size, rows, patch = self.image_size, tensordict.shape[0], self.config.patch
        conditions, device = self.conditions(tensordict, texts), tensordict[POSES].device
        if self.deterministic:
            clean = self.predict(None, torch.zeros(rows, device=device), conditions)
        else:
            shape = (len(self.cameras), self.chunk_length, 3, size, size)
            seed = tensordict.get(NOISE_SEED, None)
            noise = torch.randn(rows, *shape, device=device) if seed is None else seeded_noise(seed, shape)
            noise = to_cells(noise, patch)
            clean = sample(lambda x, level: self.predict(x, level, conditions), noise, self.num_denoise_steps)
        return to_uint8(from_cells(clean, patch))

    def conditions(self, tensordict: TensorDictBase, texts: Sequence[str]) -> dict[str, Any]:
        """What the denoiser knows besides the noisy chunk: its keyword arguments, computed once for all steps."""
        memory_poses, poses = tensordict[MEMORY_POSES].float(), tensordict[POSES].float()
        every = torch.cat([memory_poses, poses], 1)  # [B, M + C, 13]
        vectors = self._pose_vectors(every)
        return {
            "views": [self._view(index, tensordict, every, texts) for index in range(len(self.cameras))],
            "opening": poses[..., 12],
            "poses": vectors[:, _MEMORY:],
            "condition": torch.cat([vectors.flatten(1), tensordict[PADDED_ACTIONS].float().flatten(1)], -1),
        }

    @torch.no_grad()
    def _view(self, index: int, tensordict: TensorDictBase, every: Tensor, texts: Sequence[str]) -> View:
        """What one camera shows; ``every`` [B, M + C, 13] are the poses of memory and chunk."""
        camera, calibrations = self.cameras[index], self._views[index]
        action_map = cast(ActionMap, self.action_maps[index])
        which = calibrations.indices(texts)  # [B]
        poses, size = every[:, _MEMORY:], self.image_size
        if calibrations.any_mounted:
            mounted = calibrations.mounted[which].to(every.device).view(-1, 1, 1)
            seen_from = every[:, _MEMORY - 1 : _MEMORY].expand_as(every)  # the camera, as it saw the last frame
            drawn = {"tool_pose": seen_from}
            carried = torch.where(mounted, poses, seen_from[:, _MEMORY:])
            along = {"tool_pose": carried}
        else:
            drawn, along = {}, {}
        pixels = action_map.project(every[..., :3], which, **drawn)  # cells of the finest grid
        maps = torch.cat([action_map(every, which, **drawn), tool_coordinates(pixels, action_map.height)], 2)
        motion = (pixels[:, _MEMORY:] - pixels[:, _MEMORY - 1 : _MEMORY]) * self.config.patch
        if calibrations.any_mounted:
            motion = torch.where(mounted, -motion, motion)
        return View(
            memory=to_float(tensordict[memory_key(camera)]),
            memory_maps=maps[:, :_MEMORY],
            maps=maps[:, _MEMORY:],
            motion=motion.clamp(-size, size),
            hand=hand_plane(poses, lambda points: action_map.project(points, which, **along), action_map.height),
            reference=to_float(tensordict[reference_key(camera)]),
        )

    def predict(self, noisy: Tensor | None, level: Tensor, conditions: dict[str, Any]) -> Tensor:
        """x_0 from the noisy chunk (None: zeros) at noise level [B] (0: pure noise or zeros).

        Both are float cells [B, V, C, 3, patch^2, h, w] of images in [-1, 1], see :func:`to_cells`.
        """
        with torch.autocast(level.device.type, torch.bfloat16, enabled=self.predicts_in_bfloat16(level.device)):
            return self.denoiser(noisy, level, **conditions)

    def predicts_in_bfloat16(self, device: torch.device) -> bool:
        """Whether the network runs in bfloat16 on ``device``; see :attr:`VideoWorldModelConfig.precision`."""
        if self.config.precision == "auto":
            return device.type != "cpu" or torch.cpu._is_amx_tile_supported()
        return self.config.precision == "bfloat16"

    @staticmethod
    def _pose_vectors(poses: Tensor) -> Tensor:
        """Position since the last remembered frame, position, rotation, opening: [B, M + C, 13] -> [B, M + C, 16]."""
        position = poses[..., :3] * _POSITION_SCALE
        origin = position[:, _MEMORY - 1 : _MEMORY]
        return torch.cat([position - origin, 0.3 * position, poses[..., 3:]], -1)

    def _check(self, tensordict: TensorDictBase) -> None:
        size, chunk = self.image_size, self.chunk_length
        for camera in self.cameras:
            frames = tensordict.get(memory_key(camera), None)
            if frames is None or frames.dtype != torch.uint8 or tuple(frames.shape[1:]) != (_MEMORY, 3, size, size):
                got = "nothing" if frames is None else f"{frames.dtype} {tuple(frames.shape)}"
                raise ValueError(f"{memory_key(camera)} must be uint8 [B, {_MEMORY}, 3, {size}, {size}], got {got}")
        for key, width in ((POSES, POSE_DIM), (PADDED_ACTIONS, PADDED_ACTION_DIM)):
            if tuple(tensordict[key].shape[1:]) != (chunk, width):
                raise ValueError(f"{key} must be [B, {chunk}, {width}], got {tuple(tensordict[key].shape)}")
