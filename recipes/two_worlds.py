"""The same initial states and the same actions, lived in the physics and imagined in the world model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType

from physics import chunk_player, starting_at, step_env, tabletop
from run import Run
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import Episodes, episodes_from_rollouts, imagine_episodes, score_episodes
from worldenv_trl.envs import context_id
from worldenv_trl.metrics import first_success, honesty, judged
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.world_models import WorldModel


@dataclass(frozen=True)
class TwoWorlds:
    """Episodes ``[R]`` of the physics, what imagination makes of their actions, and what is judged of both.

    ``real_scores`` and ``imagined_scores`` are R(o_1:t, g) ``[R, T + 1]``; ``real_stop`` and ``imagined_stop`` int64
    ``[R]`` the frame at which the reflector's rule ends the episode, -1 if never.
    """

    episodes: Episodes
    imagined: Episodes
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


def live(run: Run, actor: TensorDictModuleBase, states: Sequence[int], split: str = "test") -> Episodes:
    """Greedy episodes of every task in the physics, each to the step limit whether the goal is reached or not.

    Returns:
        Episodes ``[R]`` (:func:`~worldenv_trl.data.episodes_from_rollouts`) from the initial states of the split with
        these numbers, task after task.
    """
    config, parts = run.config, []
    for task in config.tasks:
        options = starting_at(config, split, task, states)
        collector = GroupCollector(
            step_env(config, split, len(states), [task], terminate_on_success=False, **options),
            chunk_player(actor, config.chunk_length),
            groups_per_batch=len(states),
            total_groups=len(states),
            max_decisions=config.max_steps,
            exploration_type=ExplorationType.DETERMINISTIC,
        )
        parts.append(episodes_from_rollouts(next(iter(collector))[:, 0]))
        collector.shutdown()
    return Episodes.cat(parts)


def imagine(
    run: Run, world_model: WorldModel, reflector: Reflector, rules: dict[str, StopRule], episodes: Episodes
) -> TwoWorlds:
    """The actions of physical ``episodes`` in imagination, and the reflector's view of both."""
    imagined = imagine_episodes(world_model, episodes, run.kinematics)
    scores = {
        world: score_episodes(reflector.for_world(world), shown)
        for world, shown in (("real", episodes), ("imagined", imagined))
    }
    stops = {name: rules[name].first(values, episodes.alive) for name, values in scores.items()}
    return TwoWorlds(episodes, imagined, scores["real"], scores["imagined"], stops["real"], stops["imagined"])


def relive(run: Run, imagined: Episodes | TensorDictBase, split: str = "train") -> Tensor:
    """Success bool ``[R, T + 1]`` in the physics of the actions of ``imagined`` episodes (or their entries alone).

    Each row starts from the initial state that its ``context_id`` names; nothing is rendered. Past an episode's end the
    last value is repeated.
    """
    config = run.config
    context, length = imagined[keys.CONTEXT_ID].squeeze(-1), imagined["length"]
    success = torch.zeros(*imagined["actions"].shape[:2], dtype=torch.bool)
    for number, name in enumerate(config.tasks):
        rows = (imagined[keys.TASK_ID].squeeze(-1) == number).nonzero().squeeze(-1)
        if not len(rows):
            continue
        index = context[rows] - context_id(number, split, 0)
        env = tabletop(
            config,
            split,
            len(rows),
            [name],
            cameras=(),
            terminate_on_success=False,
            **starting_at(config, split, name, index.tolist()),
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
    frame = torch.arange(worlds.real_scores.shape[1])
    camera = worlds.imagined.cameras[0]
    return honesty(
        imagined,
        real,
        imagined_steps=worlds.imagined_stop[rows],
        real_steps=worlds.reached[rows],
        imagined_frames=worlds.imagined.frames(camera, rows.unsqueeze(-1), frame),
        real_frames=worlds.episodes.frames(camera, rows.unsqueeze(-1), frame),
        length=worlds.episodes["length"][rows],
    )
