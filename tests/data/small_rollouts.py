"""Small rollouts through two cameras, of single actions and of chunks, and episodes whose frames tell their place."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict
from torch import Tensor

from worldenv_trl import keys
from worldenv_trl.data import Episodes
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.robot import panda

CAMERAS = ("agentview", "wrist")
ENTRIES = ("image", "wrist_image")


def step_rollouts(
    lengths: Sequence[int], steps: int, size: int = 8, seed: int = 0, cameras: Sequence[str] = CAMERAS
) -> TensorDict:
    """Rollouts [R, T] of single actions; observations and actions are random, finished rows go on with rubbish."""
    generator = torch.Generator().manual_seed(seed)
    rows = len(lengths)
    images = {
        keys.image_entry(camera): torch.randint(
            0, 256, (rows, steps + 1, 3, size, size), generator=generator, dtype=torch.uint8
        )
        for camera in cameras
    }
    state = torch.randn(rows, steps + 1, 7, generator=generator)
    kinematic = torch.randn(rows, steps + 1, 20, generator=generator)
    success = torch.rand(rows, steps + 1, 1, generator=generator) < 0.3
    done = torch.arange(1, steps + 1) >= torch.tensor(lengths).unsqueeze(-1)

    def observed(part: slice) -> dict:
        return {
            "observation": {**{name: image[:, part] for name, image in images.items()}, "state": state[:, part]},
            keys.KINEMATIC_STATE: kinematic[:, part],
            keys.SUCCESS: success[:, part],
            keys.TASK_ID: torch.arange(rows).view(rows, 1, 1).expand(rows, steps, 1),
            keys.CONTEXT_ID: 100 + torch.arange(rows).view(rows, 1, 1).expand(rows, steps, 1),
        }

    out = TensorDict(
        {
            **observed(slice(0, -1)),
            keys.ACTION: 2 * torch.randn(rows, steps, 7, generator=generator),
            "next": {**observed(slice(1, None)), "done": done.unsqueeze(-1)},
        },
        batch_size=[rows, steps],
    )
    return told(out)


def told(rollouts: TensorDict) -> TensorDict:
    """Every row is told a goal of its own, from its first step to its last."""
    rows, steps = rollouts.shape
    texts = [NonTensorData(f"goal {row}", batch_size=[steps]) for row in range(rows)]
    return rollouts.set(keys.INSTRUCTION, NonTensorStack(*texts))


def decision_rollouts(
    executed: Sequence[Sequence[int]],
    chunk: int = 3,
    size: int = 8,
    success: bool = False,
    cameras: Sequence[str] = CAMERAS,
) -> TensorDict:
    """Rollouts [R, D] of chunks of which ``executed[row][decision]`` steps were executed; 0 after the end."""
    generator = torch.Generator().manual_seed(3)
    counts = torch.tensor(executed)
    rows, decisions = counts.shape
    shape = (rows, decisions, chunk)
    frames = {
        keys.image_entry(camera): torch.randint(0, 256, (*shape, 3, size, size), generator=generator, dtype=torch.uint8)
        for camera in cameras
    }
    states, kinematic = torch.randn(*shape, 7, generator=generator), torch.randn(*shape, 20, generator=generator)
    last = (counts - 1).clamp(min=0)
    row, decision = torch.meshgrid(torch.arange(rows), torch.arange(decisions), indexing="ij")

    def final(values: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        after = values[row, decision, last]
        return torch.cat([first.unsqueeze(1), after[:, :-1]], 1), after

    dark = torch.zeros(rows, 3, size, size, dtype=torch.uint8)
    images = {name: final(video, dark) for name, video in frames.items()}
    state, kin = final(states, torch.ones(rows, 7)), final(kinematic, torch.ones(rows, 20))
    ids = torch.zeros(rows, decisions, 1, dtype=torch.int64)
    common = {keys.TASK_ID: ids, keys.CONTEXT_ID: ids}
    out = TensorDict(
        {
            "observation": {**{name: image[0] for name, image in images.items()}, "state": state[0]},
            keys.KINEMATIC_STATE: kin[0],
            **common,
            keys.CHUNK: 2 * torch.randn(*shape, 7, generator=generator),
            keys.MASK: counts > 0,
            "next": {
                "observation": {**{name: image[1] for name, image in images.items()}, "state": state[1]},
                keys.KINEMATIC_STATE: kin[1],
                **common,
                keys.FRAMES: frames,
                keys.STATES: states,
                keys.KINEMATIC_STATES: kinematic,
                keys.STEP_MASK: torch.arange(chunk) < counts.unsqueeze(-1),
            },
        },
        batch_size=[rows, decisions],
    )
    if success:
        reached = torch.rand(rows, decisions, 1, generator=generator) < 0.5
        out[keys.SUCCESS] = torch.cat([torch.zeros_like(reached[:, :1]), reached[:, :-1]], 1)
        out["next", keys.SUCCESS] = reached
    return told(out)


def make_episodes(
    lengths: Sequence[int], cameras: Sequence[str] = CAMERAS, size: int = 8, first_value: int = 0
) -> Episodes:
    """Frames of the first camera are 50 x episode + number, from ``first_value`` on, those of the next 7 more.

    States tell the same number, actions are random and the hand starts at home.
    """
    rows, steps = len(lengths), max(lengths)
    length = torch.tensor(lengths).unsqueeze(-1)
    place = torch.arange(rows).view(-1, 1) * 50 + torch.minimum(torch.arange(steps + 1), length) + first_value
    home = ForwardKinematics().initial_state(torch.as_tensor(panda.HOME_Q, dtype=torch.float32).expand(rows, 7))
    actions = torch.rand(rows, steps, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1
    entries = TensorDict(
        {
            "states": place.float().unsqueeze(-1).repeat(1, 1, 7),
            "kinematic_states": home.unsqueeze(1).repeat(1, steps + 1, 1),
            "actions": actions * (torch.arange(steps) < length).unsqueeze(-1),
            "success": torch.arange(steps + 1) >= length,
            "length": length,
            keys.TASK_ID: torch.arange(rows).unsqueeze(-1),
            keys.CONTEXT_ID: 100 + torch.arange(rows).unsqueeze(-1),
        },
        batch_size=[rows],
    )
    value = place[torch.arange(steps + 1) <= length]  # [F]
    frames = TensorDict(
        {
            keys.frames_key(camera): (value + 7 * index).to(torch.uint8).view(-1, 1, 1, 1).repeat(1, 3, size, size)
            for index, camera in enumerate(cameras)
        },
        batch_size=[len(value)],
    )
    return Episodes(entries, [f"goal {row}" for row in range(rows)], frames)


def same(first: Episodes, second: Episodes) -> bool:
    """Whether two sets of episodes hold the same, frames included."""
    if first.instructions != second.instructions or set(first.entries.keys()) != set(second.entries.keys()):
        return False
    if set(first.cameras) != set(second.cameras) or not bool((first.entries == second.entries).all()):
        return False
    row, step = torch.arange(len(first)).unsqueeze(-1), torch.arange(first["actions"].shape[1] + 1)
    return all(
        torch.equal(first.frames(camera, row, step), second.frames(camera, row, step)) for camera in first.cameras
    )
