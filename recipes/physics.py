"""The tabletop in MuJoCo as the stages use it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.transforms import InitTracker, TransformedEnv
from torchrl.modules import MultiStepActorWrapper

from config import WorldEnvConfig
from parts import PROPRIO
from seeds import stage_seed
from worldenv_trl import keys
from worldenv_trl.envs import TabletopEnv, chunked, context_id
from worldenv_trl.policies import AutoregressiveActor, DeviceBridge, LaplaceActor, Policy, policy_actor, scale_bounds
from worldenv_trl.record import provenance
from worldenv_trl.scenes import load_task


def tabletop(
    config: WorldEnvConfig, split: str, num_envs: int, tasks: Sequence[str] | None, **options: Any
) -> TabletopEnv:
    """Some of the run's tasks (all by default), each under its number in the run.

    Stages whose initial states come in a random order give a ``seed`` of their own.
    """
    tasks = list(config.tasks if tasks is None else tasks)
    options = {
        "seed": stage_seed(config.seed, "tabletop"),
        "num_threads": config.num_threads,
        "cameras": config.cameras,
        "proprio": PROPRIO,
    } | options
    if split == "train":
        options = {"init_state_count": config.train_states} | options
    return TabletopEnv(
        tasks if len(tasks) > 1 else tasks[0],
        num_envs=num_envs,
        image_size=config.image_size,
        init_split=split,
        max_steps=config.max_steps,
        task_ids=[config.tasks.index(task) for task in tasks],
        **options,
    )


def step_env(
    config: WorldEnvConfig, split: str, num_envs: int, tasks: Sequence[str] | None = None, **options: Any
) -> TransformedEnv:
    """Physics, one action a step (every frame is seen), with the ``is_init`` that :func:`chunk_player` needs."""
    return TransformedEnv(tabletop(config, split, num_envs, tasks, **options), InitTracker())


def starting_at(config: WorldEnvConfig, split: str, task: str, indices: Sequence[int]) -> dict[str, Any]:
    """Options of :func:`tabletop` whose rows start from these initial states of a split, in order."""
    number = config.tasks.index(task)
    return {
        "init_states": load_task(task).init_states(split, max(indices) + 1)[list(indices)],
        "context_ids": [context_id(number, split, index) for index in indices],
        "init_state_mode": "cycle",
    }


def physics_waves_env(config: WorldEnvConfig, groups: int, group_size: int, **more: Any) -> EnvBase:
    """Physics, one chunk a step, rows in groups that share an initial state: LOOP's upper bound."""
    options = {"group_repeats": group_size, "with_sim_state": True} | more
    return chunked(tabletop(config, "train", groups * group_size, None, **options), config.chunk_length)


def chunk_player(actor: LaplaceActor | AutoregressiveActor, chunk_length: int) -> MultiStepActorWrapper:
    """Plays the actor's chunks open loop, one action a step. Its log-probs are stale: never train on them."""
    return MultiStepActorWrapper(DeviceBridge(actor), n_steps=chunk_length)


def exploring_actor(
    config: WorldEnvConfig, policy: Policy, scale_factor: float, noise: str = "step"
) -> LaplaceActor | AutoregressiveActor:
    """The stochastic actor of exploration and LOOP, a Laplace scale bounded below. Mean and scale are of single steps
    whatever the ``noise``."""
    bounds = scale_bounds(policy, config.scale_floor, share=config.scale_share)
    events = 0 if config.post_train.ratio_level == "token" else 1
    return policy_actor(policy, scale_factor=scale_factor, log_scale_bounds=bounds, event_dims=events, noise=noise)


def reached_goal(rollouts: TensorDictBase) -> torch.Tensor:
    """Whether the goal held at any step of each rollout ``[*B, T]``: bool ``[*B]``."""
    return (rollouts["next", keys.SUCCESS].squeeze(-1) & rollouts[keys.MASK]).any(-1)


def recording(config: WorldEnvConfig, env: EnvBase, stage: str, models: dict | None = None, **more: Any) -> dict:
    """What a recording of a stage must say about itself, so that it can be replayed: options of RolloutWriter."""
    more = {"stage": stage, "seed": config.seed} | more
    return provenance(env, models=models, config=config, tasks=config.tasks, **more)
