"""The instant reflector: real rollouts plus imagined replays of the same actions, labelled by the physics.

Alone: ``python recipes/train_reflector.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

from config import WorldEnvConfig
from parts import (
    build_reflector,
    holdout_split,
    imagine_episodes,
    load_world_model,
    read_episodes,
    seed_everything,
    train_reward_head,
)
from run_folder import RunFolder

from worldenv_trl.data import concatenate_episodes


def run(config: WorldEnvConfig, folder: RunFolder, target: str = "reflector", models: str = "", round: int = 1) -> None:
    """Reads the rollouts of rounds up to ``round``; writes ``checkpoints/<target>`` and its held-out figures."""


if __name__ == "__main__":
    from world_env import run_single

    run_single("train_reflector")
