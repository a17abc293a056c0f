"""Success of a policy, greedy unless told otherwise, in the physics and in imagination."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.transforms import TransformedEnv
from torchrl.envs.utils import ExplorationType
from tqdm import tqdm

from collecting import of_worker, rows_of_waves
from config import WorldEnvConfig
from imagination import Imagination
from parts import PROPRIO
from physics import starting_at, tabletop
from run import Run
from worldenv_trl import keys
from worldenv_trl.envs import Reflect, chunked, context_id
from worldenv_trl.policies import DeviceBridge
from worldenv_trl.record import RolloutWriter
from worldenv_trl.reflectors import Reflector, StopRule


@dataclass(frozen=True)
class Judge:
    """A reflector in front of real cameras, and when it stops a rollout there."""

    reflector: Reflector
    rule: StopRule


def physics_outcomes(
    run: Run,
    actor: TensorDictModuleBase,
    task: str,
    split: str,
    episodes: int,
    *,
    indices: Sequence[int] | None = None,
    judge: Judge | None = None,
    writer: RolloutWriter | None = None,
    label: str = "",
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
    proprio: str = PROPRIO,
) -> torch.Tensor:
    """Success bool ``[episodes]`` of the first initial states of a split, or of those at ``indices``, in order.

    The goal predicate ends an episode, or, with a ``judge``, the reflector alone does: then success is whether the
    goal holds in the moment it stops (or at the step limit). Actions are greedy unless ``exploration_type`` differs.
    """
    options: dict[str, Any] = {"init_state_count": episodes, "proprio": proprio}
    if indices is not None:  # these initial states of the split only
        episodes = len(indices)
        options = {"proprio": proprio} | starting_at(run.config, split, task, indices)
    num_envs = rows_of_waves(episodes, run.config.evaluate.num_envs)
    waves = -(-episodes // num_envs)
    options["with_sim_state"] = writer is not None
    env = outcomes_env(run.config, task, split, judge, num_envs, **options)
    collector = run.group_collector(
        env,
        DeviceBridge(actor),
        partial(outcomes_env, of_worker(run.config), task, split, judge, **options),
        steady=True,
        groups_per_batch=num_envs,
        group_size=1,
        total_groups=waves * num_envs,
        exclude=("observation", ("next", "observation")) if writer is None else (),
        exploration_type=exploration_type,
    )
    outcome: dict[int, bool] = {}
    for wave in tqdm(collector, total=waves, desc=f"{label} {task}", unit="wave", leave=False, disable=not label):
        rollouts = wave[:, 0]
        last = rollouts[keys.MASK].sum(-1) - 1
        success = rollouts["next", keys.SUCCESS].squeeze(-1)[torch.arange(num_envs), last]
        context = rollouts[keys.CONTEXT_ID][:, 0, 0]
        for number, reached in zip(context.tolist(), success.tolist(), strict=True):
            outcome.setdefault(number, reached)
        if writer is not None:
            writer.write(rollouts)
    collector.shutdown()
    return torch.tensor([outcome[number] for number in sorted(outcome)][:episodes])


def outcomes_env(
    config: WorldEnvConfig, task: str, split: str, judge: Judge | None, num_envs: int, **options: Any
) -> TransformedEnv:
    """Initial states in order; the goal predicate ends an episode or, with a ``judge``, the reflector alone."""
    options = {"init_state_mode": "cycle", "terminate_on_success": judge is None} | options
    env = tabletop(config, split, num_envs, [task], **options)
    if judge is not None:
        env = TransformedEnv(env, Reflect(judge.reflector, judge.rule))
    return chunked(env, config.chunk_length)


def imagined_outcomes(
    run: Run, actor: TensorDictModuleBase, imagination: Imagination, contexts: TensorDict
) -> torch.Tensor:
    """Whether the reflector stops the greedy policy in imagination, bool ``[K]``, for each context in order."""
    # The same noise for every policy: probes are compared with one another.
    seed = run.seed("probe")
    env = imagination.env(run, [len(contexts), 1], contexts, seed=seed)
    collector = run.group_collector(
        env,
        actor,
        imagination.makes(run, 1, contexts, seed=seed),
        steady=True,
        groups_per_batch=len(contexts),
        total_groups=len(contexts),
        exclude=("frames", ("next", "frames"), "observation", ("next", "observation")),
        exploration_type=ExplorationType.DETERMINISTIC,
    )
    wave = next(iter(collector))[:, 0]
    collector.shutdown()
    stopped = (wave["next", "terminated"].squeeze(-1) & wave[keys.MASK]).any(-1)
    order = dict(zip(wave[keys.CONTEXT_ID][:, 0, 0].tolist(), stopped.tolist(), strict=True))
    return torch.tensor([order[number] for number in contexts[keys.CONTEXT_ID].squeeze(-1).tolist()])


def greedy_outcomes(
    run: Run, actor: TensorDictModuleBase, imagination: Imagination, per_task: int
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Greedy success on up to ``per_task`` training contexts of every task: ``(real, imagined)``, each task -> bool
    ``[K]``; a task of which there is no context is left out.

    They are spread over all contexts: the first ones are the demonstrations' own.
    """
    config, contexts = run.config, imagination.contexts
    numbers = contexts[keys.CONTEXT_ID].squeeze(-1)
    chosen, real = [], {}
    for place, task in enumerate(config.tasks):
        first = context_id(place, "train", 0)
        rows = ((numbers >= first) & (numbers < first + config.train_states)).nonzero().squeeze(-1)
        if len(rows):
            rows = rows[torch.linspace(0, len(rows) - 1, min(per_task, len(rows))).long()]
            indices = (numbers[rows] - first).tolist()
            real[task] = physics_outcomes(run, actor, task, "train", len(indices), indices=indices)
            chosen.append(rows)
    imagined = imagined_outcomes(run, actor, imagination, contexts[torch.cat(chosen)])
    return real, dict(zip(real, imagined.split([len(rows) for rows in chosen]), strict=True))
