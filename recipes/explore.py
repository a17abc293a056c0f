"""The policy's own rollouts in the scenes at several multiples of its trained scale, labelled by the physics.

Alone: ``python recipes/explore.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

from collecting import of_worker
from config import Explore
from physics import chunk_player, exploring_actor, reached_goal, recording, step_env
from resumable import Outside, Resumable
from resumable_recording import ResumableRecording
from run import Run
from stages import run_alone


def explore(run: Run, policy: str = "sft", target: str = "explore") -> None:
    """Rolls checkpoint ``policy`` on the training initial states; writes ``rollouts/<target>.mcap``."""
    config, folder, settings = run.config, run.folder, run.config.explore
    run.seed_everything(target)
    model = run.policy(policy).eval()
    waves = waves_per_scale(settings, len(config.tasks))
    # After success the rollout goes on: the models must see what undoes it (World-Env Figure 6).
    options: dict[str, Any] = {
        "terminate_on_success": False,
        "with_sim_state": True,
        "seed": run.seed(target, "initial states"),
    }
    env = step_env(config, "train", settings.num_envs, **options)
    about = partial(recording, config, env, target, {"policy": model}, policy=policy)
    with ResumableRecording(folder.rollouts(target), about) as recorded:
        for number, factor in enumerate(settings.scale_factors):
            actor = exploring_actor(config, model, max(factor, 1e-6), settings.noise)
            player = chunk_player(actor, config.chunk_length)
            collector = run.group_collector(
                env,
                player,
                partial(step_env, of_worker(config), "train", **options),
                steady=True,
                groups_per_batch=settings.num_envs,
                group_size=1,
                total_groups=waves * settings.num_envs,
                max_decisions=config.max_steps,
            )
            # The policy stays as it is: its weights, perhaps gigabytes, are in a checkpoint of their own.
            progress = SimpleNamespace(
                state_dict=partial(collector.state_dict, weights=False), load_state_dict=collector.load_state_dict
            )
            reached: list[float] = []
            left = Resumable(
                run,
                f"scale_{number}",
                waves,
                collector=progress,
                recording=Outside(recorded),
                reached=reached,
            )
            collected = iter(collector)
            for _ in left.bar(f"{target} scale x{factor:g}", "wave"):
                rollouts = next(collected)[:, 0]
                recorded.writer.write(rollouts)
                reached.append(reached_goal(rollouts).float().mean().item())
            collector.shutdown(close_env=False)
            folder.log(
                target, scale_factor=factor, episodes=waves * settings.num_envs, success=sum(reached) / len(reached)
            )
    env.close()


def waves_per_scale(settings: Explore, tasks: int) -> int:
    """Of ``num_envs`` rollouts."""
    return -(-settings.episodes_per_task * tasks // (len(settings.scale_factors) * settings.num_envs))


def episodes_of_round(settings: Explore, tasks: int) -> int:
    """Those of all tasks, rounded up to whole waves."""
    return waves_per_scale(settings, tasks) * len(settings.scale_factors) * settings.num_envs


def rows_of_scale(settings: Explore, tasks: int, factor: float) -> slice:
    """Which episodes of a round's recording were sampled at ``factor`` times the scale."""
    count = waves_per_scale(settings, tasks) * settings.num_envs
    begin = settings.scale_factors.index(factor) * count
    return slice(begin, begin + count)


if __name__ == "__main__":
    run_alone("explore", explore)
