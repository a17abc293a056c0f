"""Scripted-expert demonstrations from some training initial states, or those of LIBERO's files.

Alone: ``python recipes/demonstrate.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from config import WorldEnvConfig
from libero_files import convert, from_libero
from physics import reached_goal, recording, tabletop
from resumable import Outside, Resumable
from resumable_recording import ResumableRecording
from run import Run
from stages import run_alone
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import ExpertPolicy, context_id
from worldenv_trl.scenes import goal_places, load_task, spread_states, usual_states


def demonstrate(run: Run) -> None:
    """Writes ``rollouts/demonstrations.mcap``; raises ``RuntimeError`` if the expert fails one."""
    config, folder = run.config, run.folder
    run.seed_everything("demonstrate")
    if from_libero(config):
        convert(run)
        return
    count = config.demonstrate.episodes_per_task
    options = {"init_state_mode": "cycle", "terminate_on_success": True, "with_sim_state": True}

    def about() -> dict[str, Any]:
        described = tabletop(config, "train", len(config.tasks), None, **options)
        said = recording(config, described, "demonstrate")
        described.close()
        return said

    with ResumableRecording(folder.rollouts("demonstrations"), about) as recorded:
        left = Resumable(run, "tasks", len(config.tasks), recording=Outside(recorded))
        for number in left.bar("demonstrate", "task"):
            task = config.tasks[number]
            env = tabletop(config, "train", count, [task], **options | _starts(config, number))
            collector = GroupCollector(
                env,
                ExpertPolicy(env),
                groups_per_batch=count,
                group_size=1,
                total_groups=count,
                max_decisions=config.max_steps,
            )
            rollouts = next(iter(collector))[:, 0]
            collector.shutdown()
            solved = reached_goal(rollouts)
            check_solved(task, solved)
            recorded.writer.write(rollouts)
            folder.log(
                "demonstrate", task=task, episodes=count, steps=rollouts[keys.MASK].sum(-1).float().mean().item()
            )


def _starts(config: WorldEnvConfig, number: int) -> dict[str, Any]:
    """Of the demonstrations of a task: options of its env."""
    if config.demonstrate.states == "first":
        return {}
    task = load_task(config.tasks[number])
    states, count = task.init_states("train", config.train_states), config.demonstrate.episodes_per_task
    usual = np.flatnonzero(usual_states(task, states, share=0.5 / count))  # of half a demonstration
    alike = usual if len(usual) >= count else np.arange(len(states))
    rows = alike[spread_states(goal_places(task, states[alike]), count)].tolist()
    return {"init_states": states[rows], "context_ids": [context_id(number, "train", row) for row in rows]}


def check_solved(task: str, solved: torch.Tensor) -> None:
    if not solved.all():
        raise RuntimeError(
            f"the expert solved {int(solved.sum())} of {len(solved)} demonstrations of {task}: "
            "give it more --max-steps in another --run-dir, or see where it fails with recipes/show_scenes.py"
        )


if __name__ == "__main__":
    run_alone("demonstrate", demonstrate)
