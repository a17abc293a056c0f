"""What ImaginedEnv reads and writes, as TorchRL's specs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.data import Binary, Composite, NonTensor, Unbounded

from worldenv_trl import keys
from worldenv_trl.envs.pixels import Pixels

__all__ = ["imagined_specs"]


def imagined_specs(
    batch: torch.Size, cameras: Sequence[str], image_size: int, chunk: int, language: str, device: torch.device
) -> tuple[Composite, Composite, Composite, Unbounded, Composite]:
    """Specs of observation, state, action, reward and done.

    Args:
        batch: the env's batch size ``[G, N]``.
        cameras: whose images are painted, ``image_size`` px high and wide.
        chunk: actions of a decision.
        language: an instruction.
        device: of all entries.
    """
    image = (3, image_size, image_size)

    def pixels(*shape: int) -> Pixels:
        return Pixels((*batch, *shape), device)

    def real(*shape: int) -> Unbounded:
        return Unbounded(shape=(*batch, *shape), device=device)

    def integer() -> Unbounded:
        return Unbounded(shape=(*batch, 1), dtype=torch.int64, device=device)

    def nested(entries: dict) -> Composite:
        return Composite(entries, shape=batch, device=device)

    images = {keys.image_entry(camera): pixels(*image) for camera in cameras}
    state = {
        "observation": nested(images | {"state": real(keys.STATE_DIM)}),
        keys.KINEMATIC_STATE: real(keys.KINEMATIC_DIM),
        keys.INSTRUCTION: NonTensor(shape=batch, example_data=language, device=device),
        keys.TASK_ID: integer(),
        keys.CONTEXT_ID: integer(),
    }
    shown = {
        keys.NUM_STEPS: integer(),
        keys.FRAMES: nested({keys.image_entry(camera): pixels(chunk, *image) for camera in cameras}),
        keys.STATES: real(chunk, keys.STATE_DIM),
        keys.KINEMATIC_STATES: real(chunk, keys.KINEMATIC_DIM),
        keys.NOISE_SEED: integer(),
        keys.STEP_MASK: Binary(shape=(*batch, chunk), dtype=torch.bool, device=device),
    }
    # Unclipped Laplace samples: what is executed is clipped in the env.
    action = nested({"vla_action": nested({"chunk": real(chunk, keys.ACTION_DIM)})})
    flag = Binary(shape=(*batch, 1), dtype=torch.bool, device=device)
    done = nested({name: flag.clone() for name in ("done", "terminated", "truncated")})
    return nested(state | shown), nested(state).clone(), action, real(1), done
