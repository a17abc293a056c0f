"""What TabletopEnv reads and writes, as TorchRL's specs."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torchrl.data import Binary, Bounded, Composite, NonTensor, Unbounded

from worldenv_trl import keys
from worldenv_trl.envs.pixels import Pixels

__all__ = ["tabletop_specs"]


def tabletop_specs(
    batch: torch.Size, images: Mapping[str, tuple[int, ...]], language: str, sim_size: int | None
) -> tuple[Composite, Composite, Bounded, Unbounded, Composite]:
    """Specs of observation, state, action, reward and done.

    Args:
        batch: the env's batch size ``[n]``.
        images: shape ``(3, H, W)`` of each image below ``observation``, by name.
        language: an instruction.
        sim_size: length of ``sim_state``, or None to leave it out.
    """
    cpu = torch.device("cpu")

    def real(width: int) -> Unbounded:
        return Unbounded(shape=(*batch, width), device=cpu)

    def integer() -> Unbounded:
        return Unbounded(shape=(*batch, 1), dtype=torch.int64, device=cpu)

    def flag() -> Binary:
        return Binary(shape=(*batch, 1), dtype=torch.bool, device=cpu)

    def nested(entries: dict) -> Composite:
        return Composite(entries, shape=batch, device=cpu)

    pixels = {name: Pixels((*batch, *shape), cpu) for name, shape in images.items()}
    observation = {
        "observation": nested({**pixels, "state": real(keys.STATE_DIM)}),
        keys.KINEMATIC_STATE: real(keys.KINEMATIC_DIM),
        keys.INSTRUCTION: NonTensor(shape=batch, example_data=language, device=cpu),
        keys.TASK_ID: integer(),
        keys.CONTEXT_ID: integer(),
        keys.NUM_STEPS: integer(),
        keys.SUCCESS: flag(),
    }
    state = {keys.CONTEXT_ID: integer(), keys.NUM_STEPS: integer()}
    if sim_size is not None:
        observation[keys.SIM_STATE] = Unbounded(shape=(*batch, sim_size), dtype=torch.float64, device=cpu)
        state[keys.SIM_STATE] = observation[keys.SIM_STATE].clone()
    action = Bounded(-1.0, 1.0, shape=(*batch, keys.ACTION_DIM), device=cpu)
    done = nested({"done": flag(), "terminated": flag(), "truncated": flag()})
    return nested(observation), nested(state), action, real(1), done
