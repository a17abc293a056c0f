"""Small video world models with one camera in the world and one on the hand, and what they are asked."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from worldenv_trl.keys import frames_key
from worldenv_trl.robot import WRIST, Camera
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig, request

PULL, PUSH = "pull the drawer", "push the drawer"
# Looks at the origin from 1.2 m in front of the robot and 0.8 m above the table.
FRONT = Camera("agentview", (1.2, 0.0, 0.8), ((0.0, -0.5547, 0.83205), (1.0, 0.0, 0.0), (0.0, 0.83205, 0.5547)), 45.0)
ONE = {"agentview": {PULL: FRONT, PUSH: FRONT}}
TWO = {**ONE, "wrist": {PULL: WRIST, PUSH: WRIST}}
SMALL = {"image_size": 32, "patch": 2, "width": 16, "multipliers": (1, 2), "blocks": (1, 1), "frame_channels": 8}
DOWN = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # the hand points straight down


def fresh_model(cameras=ONE, **settings) -> VideoWorldModel:
    """As it is before training: a copy of the last frame, roughly."""
    torch.manual_seed(0)
    return VideoWorldModel(VideoWorldModelConfig.for_cameras(cameras, **{**SMALL, **settings}))


def make_model(cameras=ONE, **settings) -> VideoWorldModel:
    """One whose every parameter matters, those that start at zero included."""
    model = fresh_model(cameras, **settings)
    for parameter in model.parameters():
        parameter.data += 0.02 * torch.randn_like(parameter)
    return model.eval()


def make_request(model: VideoWorldModel, rows: int, text: str | list[str] = PULL, chunk: int | None = None):
    """A request [n] whose frames are noise; the hand wanders above the table, pointing down."""
    generator = torch.Generator().manual_seed(1)
    chunk, size = chunk or model.chunk_length, model.image_size
    poses = torch.zeros(rows, 3 + chunk, 13)
    poses[..., :3] = 0.1 * torch.rand(rows, 3 + chunk, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.1])
    poses[..., 3:12] = DOWN.flatten()
    video = {
        frames_key(camera): torch.randint(0, 256, (rows, 3, 3, size, size), dtype=torch.uint8, generator=generator)
        for camera in model.cameras
    }
    known = TensorDict({**video, "poses": poses[:, :3]}, batch_size=[rows, 3])
    place = {0: 0, 16: 1, 20: 2}  # frames of the video that a stride of 4 remembers at frame 20
    return request(
        model,
        lambda numbers: known[torch.arange(rows).unsqueeze(-1), numbers.clone().apply_(lambda number: place[number])],
        torch.full((rows,), 20),
        poses[:, 3:],
        torch.rand(rows, chunk, 7, generator=generator) * 2 - 1,
        [text] * rows if isinstance(text, str) else text,
        noise_seed=torch.arange(rows).unsqueeze(-1) + 2**60,
    )


def close(first: torch.Tensor, second: torch.Tensor) -> bool:
    """Equal up to the rounding of one intensity level: the order of sums may depend on the batch."""
    return int((first.int() - second.int()).abs().max()) <= 1
