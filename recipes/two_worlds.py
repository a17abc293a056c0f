"""The same initial states and the same actions, lived in the physics and imagined in the world model."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType

from config import WorldEnvConfig
from parts import chunk_player, step_env, tabletop
from train_reflector import all_scores, stops
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import concatenate_episodes, episodes_from_rollouts, imagine_episodes
from worldenv_trl.envs import context_id
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.metrics import honesty
from worldenv_trl.reflectors import CompactReflector
from worldenv_trl.scenes import load_task
from worldenv_trl.world_models import VideoWorldModel


@dataclass(frozen=True)
class TwoWorlds:
    """Episodes ``[R]`` of the physics, the frames that imagination makes of their actions, and what is judged of both.

    ``real_scores`` and ``imagined_scores`` are R(o_1:t, g) ``[R, T + 1]``; ``real_stop`` and ``imagined_stop`` int64
    ``[R]`` the frame at which the reflector's rule ends the episode, -1 if never.
    """

    episodes: TensorDict
    imagined_frames: Tensor  # uint8 [R, T + 1, 3, H, W]
    real_scores: Tensor
    imagined_scores: Tensor
    real_stop: Tensor
    imagined_stop: Tensor

    @property
    def reached(self) -> Tensor:
        """Frame at which the goal first holds in the physics, int64 ``[R]``; -1 if never."""
        return first_success(self.episodes["success"])

    def outcomes(self, late: int = 2) -> tuple[Tensor, Tensor]:
        """Success in imagination and in the physics, bool ``[R]`` each; see :func:`judged`."""
        return judged(self.imagined_stop, self.reached, late)


def first_success(success: Tensor) -> Tensor:
    """First True of bool ``[R, T + 1]``, -1 where there is none."""
    return torch.where(success.any(1), success.long().argmax(1), -1)


def judged(stop: Tensor, reached: Tensor, late: int = 2) -> tuple[Tensor, Tensor]:
    """What imagination says of each row, and whether it is so.

    Args:
        stop: int64 ``[R]``, where imagination stops a row as done; -1 if never.
        reached: int64 ``[R]``, where the physics first reaches the goal under the same actions; -1 if never.
        late: frames by which the physics may come after the stop: imagined time is not exact.

    Returns:
        ``imagined``, ``real`` bool ``[R]``. The stop ends the episode: a goal that is reached later does not count.
    """
    imagined = stop >= 0
    real = (reached >= 0) & (~imagined | (reached <= stop + late))
    return imagined, real


def live(config: WorldEnvConfig, actor, per_task: int, split: str = "test") -> TensorDict:
    """Greedy episodes of every task in the physics, each to the step limit whether the goal is reached or not.

    Returns:
        Episodes ``[R]`` (:func:`~worldenv_trl.data.episodes_from_rollouts`) from the first ``per_task`` initial states
        of the split.
    """
    parts = []
    for task in config.tasks:
        options = {"init_state_mode": "cycle", "init_state_count": per_task, "terminate_on_success": False}
        collector = GroupCollector(
            step_env(config, split, per_task, [task], **options),
            chunk_player(actor, config.chunk_length),
            groups_per_batch=per_task,
            total_groups=per_task,
            max_decisions=config.max_steps,
            exploration_type=ExplorationType.DETERMINISTIC,
        )
        parts.append(episodes_from_rollouts(next(iter(collector))[:, 0]))
        collector.shutdown()
    return concatenate_episodes(parts)


def imagine(world_model: VideoWorldModel, reflector: CompactReflector, episodes: TensorDict) -> TwoWorlds:
    """The actions of physical ``episodes`` [R] in imagination, and the reflector's view of both videos."""
    imagined = imagine_episodes(world_model, episodes, ForwardKinematics())
    scores = {"real": all_scores(reflector, episodes), "imagined": all_scores(reflector, imagined)}
    rule = reflector.config
    return TwoWorlds(
        episodes,
        imagined["frames"],
        scores["real"],
        scores["imagined"],
        stops(scores["real"], episodes, (rule.real_threshold, rule.real_consecutive)),
        stops(scores["imagined"], episodes, (rule.threshold, rule.consecutive)),
    )


def relive(config: WorldEnvConfig, imagined: TensorDictBase, split: str = "train") -> Tensor:
    """Success bool ``[R, T + 1]`` in the physics of the actions of ``imagined`` episodes ``[R]``, frame by frame.

    Each row starts from the initial state that its ``context_id`` names; nothing is rendered. Past an episode's end the
    last value is repeated.
    """
    context, length = imagined[keys.CONTEXT_ID].squeeze(-1), imagined["length"]
    success = torch.zeros(*imagined["actions"].shape[:2], dtype=torch.bool)
    for name in config.tasks:
        task = load_task(name)
        rows = (imagined[keys.TASK_ID].squeeze(-1) == task.task_id).nonzero().squeeze(-1)
        if not len(rows):
            continue
        index = context[rows] - context_id(task.task_id, split, 0)
        env = tabletop(
            config,
            split,
            len(rows),
            [name],
            cameras=(),
            terminate_on_success=False,
            init_states=task.init_states(split, int(index.max()) + 1)[index.tolist()],
            context_ids=context[rows].tolist(),
            init_state_mode="cycle",
        )
        state = env.reset()
        for step in range(imagined["actions"].shape[1]):
            state[keys.ACTION] = imagined["actions"][rows, step]
            state["_step"] = step < length[rows].squeeze(-1)
            state = env.step(state)["next"]
            success[rows, step] = state[keys.SUCCESS].squeeze(-1)
        env.close()
    return torch.cat([torch.zeros(len(success), 1, dtype=torch.bool), success], 1)


def honesty_of(worlds: TwoWorlds, rows: Tensor | None = None) -> dict:
    """:func:`~worldenv_trl.metrics.honesty` of some rows (all by default): outcomes, stop times and drift."""
    rows = torch.arange(len(worlds.episodes)) if rows is None else rows
    imagined, real = (side[rows] for side in worlds.outcomes())
    return honesty(
        imagined,
        real,
        imagined_steps=worlds.imagined_stop[rows],
        real_steps=worlds.reached[rows],
        imagined_frames=worlds.imagined_frames[rows],
        real_frames=worlds.episodes["frames"][rows],
        length=worlds.episodes["length"][rows],
    )
