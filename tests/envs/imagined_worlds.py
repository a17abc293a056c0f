"""ImaginedEnv over a world model whose frames are known in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NonTensorStack, TensorDict

from worldenv_trl.envs import ImaginedEnv
from worldenv_trl.keys import (
    CHUNK,
    CONTEXT_ID,
    INSTRUCTION,
    KINEMATIC_STATE,
    NOISE_SEED,
    TASK_ID,
    frames_key,
    image_entry,
)
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.robot import panda
from worldenv_trl.world_models import WorldModel, memory_key

SIZE, C = 16, 4
FK = ForwardKinematics()
TWO = ("agentview", "wrist")


class CountingWorldModel(WorldModel):
    """Red counts the frames, green is noise of the row's seed, blue the oldest remembered red. Keeps its requests."""

    def __init__(self, cameras: Sequence[str] = TWO, size: int = SIZE) -> None:
        super().__init__(cameras=cameras, image_size=size, chunk_length=C)
        self.requests: list[TensorDict] = []

    def memory_indices(self, now: torch.Tensor) -> torch.Tensor:
        return torch.stack([now // 2, now], -1)

    def forward(self, tensordict: TensorDict) -> TensorDict:
        self.requests.append(tensordict.clone())
        later, image = torch.arange(1, C + 1), (self.image_size, self.image_size)
        for index, camera in enumerate(self.cameras):
            reds = tensordict[memory_key(camera)][:, :, 0, 0, 0].long()  # [n, 2]
            frames = torch.zeros(*tensordict.shape, C, 3, *image, dtype=torch.uint8)
            frames[:, :, 0] = (reds[:, -1:] + later).to(torch.uint8)[..., None, None]
            for row, seed in enumerate(tensordict[NOISE_SEED].flatten().tolist()):
                generator = torch.Generator().manual_seed(seed + index)
                frames[row, :, 1] = torch.randint(256, (C, *image), generator=generator, dtype=torch.uint8)
            frames[:, :, 2] = reds[:, :1, None, None].to(torch.uint8)
            tensordict[frames_key(camera)] = frames
        return tensordict


def make_contexts(count: int = 5, cameras: Sequence[str] = TWO, size: int = SIZE) -> TensorDict:
    """Contexts [K] of two tasks in turn; red of the first pixels is 10 x index, and 5 more for each further camera."""
    generator = torch.Generator().manual_seed(3)
    q = torch.as_tensor(panda.HOME_Q, dtype=torch.float32) + 0.05 * torch.randn(count, 7, generator=generator)
    kinematic_state, images = FK.initial_state(q), {}
    for index, camera in enumerate(cameras):
        image = torch.randint(256, (count, 3, size, size), generator=generator, dtype=torch.uint8)
        image[:, 0] = (10 * torch.arange(count) + 5 * index).to(torch.uint8)[:, None, None]
        images[image_entry(camera)] = image
    contexts = TensorDict(
        {
            "observation": {**images, "state": FK.state(kinematic_state, "commanded")},
            KINEMATIC_STATE: kinematic_state,
            TASK_ID: torch.arange(count)[:, None] % 2,
            CONTEXT_ID: 100 + torch.arange(count)[:, None],
        },
        batch_size=[count],
    )
    contexts.set(INSTRUCTION, NonTensorStack(*["push" if i % 2 else "pull" for i in range(count)]))
    return contexts


def make_env(
    groups: int = 2, rollouts: int = 3, *, count: int = 5, world_model: WorldModel | None = None, **settings
) -> ImaginedEnv:
    world_model = world_model or CountingWorldModel()
    contexts = make_contexts(count, world_model.cameras, world_model.image_size)
    return ImaginedEnv(world_model, FK, contexts, [groups, rollouts], **{"max_steps": 3 * C, "seed": 0, **settings})


def with_chunk(td: TensorDict, scale: float = 0.5, seed: int = 1) -> TensorDict:
    """The same random chunk for a seed, whatever ``td`` holds."""
    return td.set(CHUNK, scale * torch.randn(*td.shape, C, 7, generator=torch.Generator().manual_seed(seed)))


def given(env: ImaginedEnv, picks: list[list[int]]) -> TensorDict:
    """Contexts [G, N] to start from."""
    return make_contexts(cameras=env.cameras)[torch.tensor(picks)].reshape(env.batch_size)
