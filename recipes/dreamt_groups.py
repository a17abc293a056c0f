"""Groups of rollouts as LOOP draws them in imagination, made once, then only read; what their actions come to is lived
in the physics."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path

import torch
from torch.nn import Module
from tqdm import tqdm

from imagination import contexts_of
from parts import PROPRIO
from physics import exploring_actor, recording
from real_groups import Draw, RealGroups, kept_episodes
from run import Run
from seeds import stage_seed
from two_worlds import relive
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import Episodes
from worldenv_trl.devices import to_device
from worldenv_trl.envs import ImaginedEnv
from worldenv_trl.policies import DeviceBridge, Policy
from worldenv_trl.record import RolloutWriter
from worldenv_trl.world_models import WorldModel

_ROWS = 48  # of imagination at a time: their frames are in memory


def dreamt_groups(
    run: Run,
    policy: Policy,
    world_model: WorldModel,
    groups: RealGroups,
    draw: Draw,
    folder: Path,
    overwrite: bool = False,
) -> RealGroups:
    """What ``policy`` does from where ``groups`` begin when it looks at imagined frames, to the step limit: the dreams
    in ``folder`` (``dreams.mcap``, and a store of their frames), dreamt first if there are none.

    A hand that looks at the world reacts to what happens there: a path betrays how its rollout ends, and a judge that
    tells the one from the other need not know which path would do it. What is done in a dream has seen nothing of that.

    Returns:
        As many groups, of the same contexts in the same order: imagined frames and poses, and of ``success`` what the
        physics makes of the actions.

    Raises:
        ValueError: if other models dreamt them, or as another draw.
    """
    path = folder / "dreams.mcap"
    make = partial(_dream, run, policy, world_model, groups, draw, path)
    models: dict[str, Module] = {"policy": policy, "world_model": world_model}
    dreamt = in_order(kept_episodes(run, path, draw, models, make, overwrite), groups)
    dreamt["success"] = relive(run, dreamt)
    return dataclasses.replace(groups, episodes=dreamt)


def _dream(run: Run, policy: Policy, world_model: WorldModel, groups: RealGroups, draw: Draw, path: Path) -> None:
    torch.manual_seed(stage_seed(draw.seed, "dreamt groups"))
    config, size = run.config, draw.group_size
    actor = DeviceBridge(exploring_actor(config, policy.eval(), draw.scale_factor, draw.noise))
    firsts = torch.arange(0, len(groups.episodes), size)
    with ExitStack() as stack:
        writer: RolloutWriter | None = None
        for rows in tqdm(firsts.split(max(1, _ROWS // size)), desc="groups in imagination", unit="wave"):
            contexts = contexts_of(groups.episodes[rows], world_model.cameras)
            env = ImaginedEnv(
                world_model,
                run.kinematics,
                to_device(contexts, run.device),
                [len(rows), size],
                max_steps=config.max_steps,
                proprio=PROPRIO,
                seed=stage_seed(draw.seed, f"dreamt groups {int(rows[0])}"),
            )
            if writer is None:
                about = recording(
                    config, env, "dreams", {"policy": policy, "world_model": world_model}, draw=asdict(draw)
                )
                writer = stack.enter_context(RolloutWriter(path, **about, overwrite=True))
            collector = GroupCollector(
                env, actor, groups_per_batch=len(rows), total_groups=len(rows), group_size=size, exclude=()
            )
            writer.write(next(iter(collector)).flatten(0, 1))
            collector.shutdown()


def in_order(episodes: Episodes, groups: RealGroups) -> Episodes:
    """Episodes of whole groups in the order of ``groups``, whose contexts are distinct."""
    found = groups.grouped(episodes["context_id"].squeeze(-1))[:, 0]
    place = (groups.context_id.unsqueeze(-1) == found).long().argmax(-1)  # of each group among those found
    rows = place.unsqueeze(-1) * groups.group_size + torch.arange(groups.group_size)
    return episodes[rows.flatten()]
