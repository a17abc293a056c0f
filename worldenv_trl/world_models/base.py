"""What every world model is: frames of a chunk, from remembered frames and where the hand will go."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from worldenv_trl.keys import ACTION_DIM, INSTRUCTION, NOISE_SEED, frames_key, image_entry
from worldenv_trl.language import SeenInstructions
from worldenv_trl.row_texts import row_texts

__all__ = ["PADDED_ACTIONS", "PADDED_ACTION_DIM", "POSES", "Recall", "WorldModel", "paint", "request"]

POSES = "poses"  # float32 [n, C, 13], FK-predicted: position (m), rotation (row-major), opening
PADDED_ACTIONS = "padded_actions"  # float32 [n, C, 14]
PADDED_ACTION_DIM = 14  # EVAC's dual-arm interface; a single arm fills the first seven
MEMORY_POSES = ("memory", "poses")  # float32 [n, M, 13]

Recall = Callable[[Tensor], TensorDictBase]
"""Frames of n videos: int64 [n, K], numbers of frames -> TensorDict [n, K] of ``("frames", entry)`` uint8
[n, K, 3, H, W] by camera and ``poses`` [n, K, 13]."""


def memory_key(camera: str) -> tuple[str, str, str]:
    """Where a request has the remembered frames of a scene's camera: uint8 [n, M, 3, H, W]."""
    return ("memory", "frames", image_entry(camera))


def reference_key(camera: str) -> tuple[str, str, str]:
    """Where a request has the first frame of a scene's camera: uint8 [n, 3, H, W]."""
    return ("memory", "reference", image_entry(camera))


class WorldModel(TensorDictModuleBase, abc.ABC):
    """Action-conditioned video as imagination sees it; nothing else of it is known to envs, replays and training.

    Reads a :func:`request` [n] and writes ``("frames", entry)`` uint8 [n, C, 3, H, W] for each camera. A subclass calls
    ``super().__init__`` with what it is trained for, and implements :meth:`memory_indices` and :meth:`forward`; one
    that learns also :meth:`training_loss`.

    Keyword Args:
        cameras: scene cameras that it paints, in order.
        image_size: height and width of the frames (px).
        chunk_length: C.
        instructions: those it is trained on; others are answered with a warning. Empty: it never warns.

    Raises:
        ValueError: for no camera, one that is named twice, or a size or length below 1.

    Examples:
        >>> class Still(WorldModel):  # remembers the last frame, and believes that nothing ever moves
        ...     def memory_indices(self, now):
        ...         return now.unsqueeze(-1)
        ...
        ...     def forward(self, tensordict):
        ...         for camera in self.cameras:
        ...             last = tensordict[memory_key(camera)]
        ...             tensordict[frames_key(camera)] = last.expand(-1, self.chunk_length, -1, -1, -1).clone()
        ...         return tensordict
        >>> model = Still(image_size=16, chunk_length=4)
        >>> frames = {"image": torch.zeros(2, 9, 3, 16, 16, dtype=torch.uint8)}
        >>> videos = TensorDict({"frames": frames, "poses": torch.zeros(2, 9, 13)}, [2, 9])
        >>> row, now = torch.arange(2).unsqueeze(-1), torch.tensor([0, 5])
        >>> poses, actions = torch.zeros(2, 4, 13), torch.zeros(2, 4, 7)
        >>> texts = ["open the drawer", "turn on the stove"]
        >>> asked = request(model, lambda number: videos[row, number], now, poses, actions, texts)
        >>> model(asked)["frames", "image"].shape
        torch.Size([2, 4, 3, 16, 16])
    """

    def __init__(
        self,
        *,
        cameras: Sequence[str] = ("agentview",),
        image_size: int,
        chunk_length: int,
        instructions: Sequence[str] = (),
    ) -> None:
        super().__init__()
        if not cameras or len(set(cameras)) < len(cameras):
            raise ValueError(f"cameras must name at least one camera, each once, got {tuple(cameras)}")
        if min(image_size, chunk_length) < 1:
            raise ValueError(f"image_size and chunk_length must be at least 1, got {image_size} and {chunk_length}")
        self.cameras, self.image_size, self.chunk_length = tuple(cameras), int(image_size), int(chunk_length)
        self.seen = SeenInstructions(f"the world model {type(self).__name__}", instructions)
        frames = [key(camera) for camera in self.cameras for key in (memory_key, reference_key)]
        self.in_keys = [*frames, MEMORY_POSES, POSES, PADDED_ACTIONS, INSTRUCTION]
        self.out_keys = [frames_key(camera) for camera in self.cameras]

    @property
    def instructions(self) -> tuple[str, ...]:
        """What it was trained on."""
        return self.seen.instructions

    @abc.abstractmethod
    def memory_indices(self, now: Tensor) -> Tensor:
        """Which frames of the video o_0..o_now it remembers: int64 [n] -> [n, M], newest last."""

    @abc.abstractmethod
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Paints the chunk that a :func:`request` asks for."""

    def training_loss(self, windows: TensorDictBase) -> TensorDict:
        """``loss_world_model`` (scalar) and detached figures, of windows as :func:`worldenv_trl.data.window_buffer`
        draws them.

        For training in several processes: ``weight``, the sum over which the loss is a mean (the number of windows when
        absent), and random numbers of rows drawn through :func:`worldenv_trl.row_share.own_rows`."""
        raise TypeError(f"{type(self).__name__} is not trained: it has no training_loss")


def request(
    world_model: WorldModel,
    recall: Recall,
    now: Tensor,
    poses: Tensor,
    actions: Tensor,
    instructions: Sequence[str],
    noise_seed: Tensor | None = None,
) -> TensorDict:
    """What a world model is asked for the next chunk of n videos: the only place that puts a request together.

    Instructions that the model was not trained on are warned of here, whatever model it is.

    Args:
        world_model: says which cameras it needs, and which frames it remembers.
        recall: frames and poses of the videos so far.
        now: int64 [n], the number of each video's last frame.
        poses: [n, C, 13], of the chunk, predicted by forward kinematics.
        actions: [n, C, 7], executed, in [-1, 1].
        instructions: n texts.
        noise_seed: int64 [n, 1], of what the model draws for this chunk; None leaves it to torch's generator.

    Returns:
        TensorDict [n]: ``("memory", "frames", entry)`` uint8 [n, M, 3, H, W] and ``("memory", "reference", entry)``
        uint8 [n, 3, H, W] (the video's first frame) by camera, ``("memory", "poses")`` [n, M, 13], ``poses``
        [n, C, 13], ``padded_actions`` [n, C, 14], ``language_instruction`` and, if given, ``noise_seed`` [n, 1].
    """
    world_model.seen.check(instructions)
    memory, first = recall(world_model.memory_indices(now)), recall(torch.zeros_like(now).unsqueeze(-1))
    out = TensorDict(batch_size=[len(now)], device=poses.device)
    for camera in world_model.cameras:
        out[memory_key(camera)] = memory[frames_key(camera)]
        out[reference_key(camera)] = first[frames_key(camera)][:, 0]
    out[MEMORY_POSES] = memory[POSES]
    out[POSES] = poses
    out[PADDED_ACTIONS] = torch.nn.functional.pad(actions, (0, PADDED_ACTION_DIM - ACTION_DIM))
    out.set(INSTRUCTION, row_texts(instructions))
    if noise_seed is not None:
        out[NOISE_SEED] = noise_seed
    return out


def paint(world_model: WorldModel, asked: TensorDictBase) -> dict[str, Tensor]:
    """What a world model makes of a :func:`request` [n]: uint8 [n, C, 3, H, W] by camera.

    Raises:
        ValueError: for frames that are missing, or not of its own size and length.
    """
    size = world_model.image_size
    expected = (*asked.batch_size, world_model.chunk_length, 3, size, size)
    painted, frames = world_model(asked), dict[str, Tensor]()
    for camera in world_model.cameras:
        video = painted.get(frames_key(camera), None)
        if video is None or tuple(video.shape) != expected or video.dtype != torch.uint8:
            got = "nothing" if video is None else f"{video.dtype} {tuple(video.shape)}"
            raise ValueError(
                f"the world model {type(world_model).__name__} must write {frames_key(camera)} as uint8 {expected}, "
                f"got {got}"
            )
        frames[camera] = video
    return frames
