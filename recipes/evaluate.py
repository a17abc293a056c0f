"""Greedy success on held-out initial states, before and after post-training, in both protocols.

``physics``: the goal predicate ends the episode. ``reflector``: only the reflector (or the step limit) ends it, and the
episode counts as a success if the goal holds in that moment (World-Env Table 3).
Alone: ``python recipes/evaluate.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

from typing import Any

import torch

from outcomes import Judge, outcomes_env, physics_outcomes
from physics import recording
from resumable import Outside, Resumable
from resumable_recording import ResumableRecording
from run import Run
from run_folder import RunFolder
from stages import run_alone
from worldenv_trl.metrics import paired_test, wilson_interval
from worldenv_trl.policies import policy_actor


def evaluate(run: Run, before: str, after: str, models: str | None) -> None:
    """Evaluates checkpoints ``before`` and ``after`` on the same held-out initial states.

    Without ``models`` there is no reflector, and its protocol is left out.
    """
    folder = run.folder
    run.seed_everything("evaluate")
    reflector = None if models is None else Judge(run.reflector(models).for_world("real"), run.rules(models)["real"])
    protocols = ("physics",) if reflector is None else ("physics", "reflector")
    pairs = [(protocol, name) for protocol in protocols for name in (before, after)]
    found: list[dict[str, list[bool]]] = []  # of each pair, by task
    for index in Resumable(run, "policies", len(pairs), minutes=0, found=found):
        protocol, name = pairs[index]
        success = rolled(run, protocol, name, reflector if protocol == "reflector" else None)
        found.append({task: each.tolist() for task, each in success.items()})
        if name == after:  # a checkpoint sorts the tasks by name: both must come in the run's order
            earlier, later = ({task: torch.tensor(one[task]) for task in run.config.tasks} for one in found[-2:])
            log_protocol(folder, "evaluate", protocol, {before: earlier, after: later})


def rolled(run: Run, protocol: str, name: str, judge: Judge | None) -> dict[str, torch.Tensor]:
    """Success bool ``[episodes]`` of a policy in every task; writes its recording."""
    config, policy = run.config, run.policy(name)
    actor = policy_actor(policy)

    def about() -> dict[str, Any]:
        described = outcomes_env(config, config.tasks[0], "test", judge, 1, with_sim_state=True, proprio=policy.proprio)
        taking_part = {"policy": policy} | ({} if judge is None else {"reflector": judge.reflector})
        said = recording(config, described, "evaluate", taking_part, policy=name, protocol=protocol)
        described.close()
        return said

    success: dict[str, list[bool]] = {}
    with ResumableRecording(run.folder.rollouts(f"evaluate_{protocol}_{name}"), about) as recorded:
        parts = {"recording": Outside(recorded), "success": success}
        for number in Resumable(run, f"{protocol} {name}", len(config.tasks), minutes=0, **parts):
            task = config.tasks[number]
            outcomes = physics_outcomes(
                run,
                actor,
                task,
                "test",
                config.evaluate.episodes_per_task,
                judge=judge,
                writer=recorded.writer,
                label=f"{name}, {protocol} stops",
                proprio=policy.proprio,
            )
            success[task] = outcomes.tolist()
    return {task: torch.tensor(success[task]) for task in config.tasks}


def log_protocol(folder: RunFolder, stage: str, protocol: str, outcomes: dict[str, dict[str, torch.Tensor]]) -> None:
    """Of one policy, by task, or of two and how they differ."""
    whole = {name: {"all": torch.cat(list(per_task.values()))} | per_task for name, per_task in outcomes.items()}
    for name, per_task in whole.items():
        for task, success in per_task.items():
            _log(folder, stage, protocol, name, task, success)
    if len(whole) == 1:
        return
    earlier, later = whole.values()
    for task, success in earlier.items():
        test = paired_test(success, later[task])
        folder.log(stage, protocol=protocol, task=task, paired=True, **{k: float(v) for k, v in test.items()})


def _log(folder: RunFolder, stage: str, protocol: str, policy: str, task: str, success: torch.Tensor) -> None:
    low, high = wilson_interval(int(success.sum()), len(success))
    folder.log(
        stage,
        protocol=protocol,
        policy=policy,
        task=task,
        success=success.float().mean().item(),
        low=float(low),
        high=float(high),
        episodes=len(success),
    )


if __name__ == "__main__":
    run_alone("evaluate", evaluate)
