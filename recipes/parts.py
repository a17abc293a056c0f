"""Builds and loads the parts that the stages compose: environments, policies, models."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.transforms import InitTracker, TransformedEnv
from torchrl.modules import MultiStepActorWrapper

from config import WorldEnvConfig
from run_folder import RunFolder
from worldenv_trl import keys
from worldenv_trl.data import concatenate_episodes, episodes_from_rollouts
from worldenv_trl.envs import ImaginedEnv, Reflect, TabletopEnv, chunked
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.policies import LaplaceActor, OFTPolicy, laplace_actor
from worldenv_trl.record import provenance, read_rollouts
from worldenv_trl.reflectors import CompactReflector
from worldenv_trl.scenes import load_task
from worldenv_trl.world_models import VideoWorldModel

PROPRIO = "commanded"  # the same in physics and imagination, so the policy meets no gap between them


def check_config(config: WorldEnvConfig) -> None:
    """Fails before any long work starts if a task is unknown, a setting impossible or no GL backend renders."""
    if not config.tasks:
        raise ValueError("tasks is empty: name at least one task, for instance starter/open_the_top_drawer")
    if len(set(config.tasks)) < len(config.tasks):
        raise ValueError(f"tasks names a task twice: {', '.join(config.tasks)}")
    for name, value, known in (
        ("post_train.env", config.post_train.env, ("imagined", "tabletop")),
        ("post_train.ratio_level", config.post_train.ratio_level, ("step", "chunk")),
    ):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    for name, value in (
        ("num_threads", config.num_threads),
        ("rounds", config.rounds),
        ("train_states", config.train_states),
        ("demonstrate.episodes_per_task", config.demonstrate.episodes_per_task),
        ("explore.episodes_per_task", config.explore.episodes_per_task),
        ("explore.num_envs", config.explore.num_envs),
        ("sft.steps", config.sft.steps),
        ("world_model.steps", config.world_model.steps),
        ("post_train.iterations", config.post_train.iterations),
        ("post_train.groups", config.post_train.groups),
        ("evaluate.episodes_per_task", config.evaluate.episodes_per_task),
    ):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if config.post_train.group_size < 2:
        raise ValueError(f"post_train.group_size must be at least 2, got {config.post_train.group_size}")
    if not config.explore.scale_factors or min(config.explore.scale_factors) < 0:
        raise ValueError(
            f"explore.scale_factors must be one number or more, none negative, got {config.explore.scale_factors}"
        )
    for name, value in (
        ("world_model.failure_share", config.world_model.failure_share),
        ("world_model.holdout", config.world_model.holdout),
        ("reflector.imagined_share", config.reflector.imagined_share),
        ("reflector.holdout", config.reflector.holdout),
    ):
        if value is not None and not 0 <= value <= 1:
            raise ValueError(f"{name} must lie between 0 and 1, got {value}")
    if not all(floor > 0 for floor in config.scale_floor):
        raise ValueError(f"scale_floor must be positive, got {config.scale_floor}")
    if not 0 <= config.scale_share <= 1:
        raise ValueError(f"scale_share must lie between 0 and 1, got {config.scale_share}")
    if config.image_size < 32 or config.image_size % 16:
        raise ValueError(f"image_size must be a multiple of 16 px and at least 32, got {config.image_size}")
    if config.max_steps < 1 or config.max_steps % config.chunk_length:
        raise ValueError(f"max_steps must be a multiple of chunk_length={config.chunk_length}, got {config.max_steps}")
    for task in config.tasks:
        load_task(task)
    tabletop(config, "train", 1, config.tasks[:1]).close()


def seed_everything(config: WorldEnvConfig, offset: int) -> None:
    """Each stage has its own stream, so a stage run alone draws the same numbers as in the whole loop."""
    torch.manual_seed(1000 * config.seed + offset)


def task_instructions(config: WorldEnvConfig) -> dict[int, str]:
    return {task.task_id: task.language for task in map(load_task, config.tasks)}


def step_env(
    config: WorldEnvConfig, split: str, num_envs: int, tasks: Sequence[str] | None = None, **options
) -> TransformedEnv:
    """Physics, one action a step (every frame is seen), with the ``is_init`` that :func:`chunk_player` needs."""
    return TransformedEnv(tabletop(config, split, num_envs, tasks, **options), InitTracker())


def physics_waves_env(config: WorldEnvConfig, groups: int, group_size: int) -> EnvBase:
    """Physics, one chunk a step, rows in groups that share an initial state: LOOP's upper bound."""
    return chunked(
        tabletop(config, "train", groups * group_size, None, group_repeats=group_size, with_sim_state=True),
        config.chunk_length,
    )


def tabletop(config: WorldEnvConfig, split: str, num_envs: int, tasks: Sequence[str] | None, **options) -> TabletopEnv:
    tasks = list(config.tasks if tasks is None else tasks)
    options = {"seed": config.seed, "num_threads": config.num_threads, "proprio": PROPRIO} | options
    if split == "train":
        options = {"init_state_count": config.train_states} | options
    return TabletopEnv(
        tasks if len(tasks) > 1 else tasks[0],
        num_envs=num_envs,
        image_size=config.image_size,
        init_split=split,
        max_steps=config.max_steps,
        **options,
    )


def imagined_env(
    config: WorldEnvConfig,
    world_model: VideoWorldModel,
    reflector: CompactReflector,
    contexts: TensorDict,
    batch_size: Sequence[int],
) -> TransformedEnv:
    """Imagination: FK, action map, world model; the reflector gives the reward and stops."""
    env = ImaginedEnv(
        world_model,
        ForwardKinematics(),
        contexts,
        batch_size=list(batch_size),
        max_steps=config.max_steps,
        chunk_length=config.chunk_length,
        proprio=PROPRIO,
        seed=config.seed,
    )
    return TransformedEnv(env, stopping_rule(reflector))


def stopping_rule(reflector: CompactReflector, *, real: bool = False) -> Reflect:
    """The stopping rules that were chosen when the reflector was trained, for imagined and for ``real`` frames."""
    config = reflector.config
    if real:
        return Reflect(reflector, threshold=config.real_threshold, consecutive=config.real_consecutive)
    return Reflect(reflector, threshold=config.threshold, consecutive=config.consecutive)


def recording(config: WorldEnvConfig, env: EnvBase, stage: str, models: dict | None = None, **more) -> dict:
    """What a recording of a stage must say about itself, so that it can be replayed: options of RolloutWriter."""
    more = {"stage": stage, "seed": config.seed} | more
    return provenance(env, models=models, config=config, tasks=config.tasks, **more)


def chunk_player(actor, chunk_length: int) -> MultiStepActorWrapper:
    """Plays the actor's chunks open loop, one action a step. Its log-probs are stale: never train on them."""
    return MultiStepActorWrapper(actor, n_steps=chunk_length)


def exploring_actor(config: WorldEnvConfig, policy: OFTPolicy, scale_factor: float) -> LaplaceActor:
    """The stochastic actor of exploration and LOOP, its scale bounded below."""
    position, rotation, gripper = config.scale_floor
    floors = torch.tensor([*3 * [position], *3 * [rotation], gripper])
    low = torch.maximum(floors, config.scale_share * policy.action_half_range.cpu()).log().tolist()
    # The upper bound stays above every floor, whatever the floors are set to.
    return laplace_actor(policy, scale_factor=scale_factor, log_scale_bounds=(low, max(-1.5, *(x + 1 for x in low))))


def load_policy(folder: RunFolder, name: str, stage: str) -> OFTPolicy:
    return OFTPolicy.from_pretrained(folder.require_checkpoint(name, stage))


def load_world_model(folder: RunFolder, suffix: str) -> VideoWorldModel:
    model = VideoWorldModel.from_pretrained(folder.require_checkpoint(f"world_model{suffix}", "train_world_model"))
    return model.eval()


def load_reflector(folder: RunFolder, suffix: str) -> CompactReflector:
    model = CompactReflector.from_pretrained(folder.require_checkpoint(f"reflector{suffix}", "train_reflector"))
    return model.eval().requires_grad_(False)


def read_episodes(folder: RunFolder, rounds: int) -> tuple[TensorDict, TensorDict]:
    """Demonstrations, and the exploration of the first ``rounds`` rounds, as episodes."""
    demonstrations = folder.require_rollouts("demonstrations", "demonstrate")
    names = ["explore" + ("" if number == 1 else f"_{number}") for number in range(1, rounds + 1)]
    explored = [folder.require_rollouts(name, "explore") for name in names]
    return (
        episodes_from_rollouts(read_rollouts(demonstrations)),
        concatenate_episodes([episodes_from_rollouts(read_rollouts(path)) for path in explored]),
    )


def read_contexts(folder: RunFolder) -> TensorDict:
    """The distinct training contexts (g, o_1, s_1) among the logged exploration rollouts; no simulator is touched."""
    first = read_rollouts(folder.require_rollouts("explore", "explore"))[:, 0]
    ids = first[keys.CONTEXT_ID].squeeze(-1)
    rows = [int((ids == value).nonzero()[0, 0]) for value in ids.unique()]
    return first[rows].select(
        keys.IMAGE, keys.STATE, keys.KINEMATIC_STATE, keys.INSTRUCTION, keys.TASK_ID, keys.CONTEXT_ID
    )


def split_by_context(episodes: TensorDict, share: float, seed: int) -> tuple[TensorDict, TensorDict]:
    """Episodes for training, and those of a ``share`` of the initial states (at least one) for figures."""
    contexts = episodes[keys.CONTEXT_ID].squeeze(-1)
    distinct = contexts.unique()
    order = torch.randperm(len(distinct), generator=torch.Generator().manual_seed(seed))
    kept_out = torch.isin(contexts, distinct[order[: max(1, round(share * len(distinct)))]])
    return episodes[~kept_out], episodes[kept_out]
