"""Greedy success on held-out initial states, before and after post-training, in both protocols.

``physics``: the goal predicate ends the episode. ``reflector``: only the reflector (or the step limit) ends it, and the
episode counts as a success if the goal holds in that moment (World-Env Table 3).
Alone: ``python recipes/evaluate.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import torch

from outcomes import Judge, outcomes_env, physics_outcomes
from physics import recording
from run import Run
from run_folder import RunFolder
from stages import run_alone
from worldenv_trl.metrics import paired_test, wilson_interval
from worldenv_trl.policies import laplace_actor
from worldenv_trl.record import RolloutWriter


def evaluate(run: Run, before: str, after: str, models: str | None) -> None:
    """Evaluates checkpoints ``before`` and ``after`` on the same held-out initial states.

    Without ``models`` there is no reflector, and its protocol is left out.
    """
    config, folder = run.config, run.folder
    run.seed_everything("evaluate")
    reflector = None if models is None else Judge(run.reflector(models), run.rules(models)["real"])
    for protocol in ("physics",) if reflector is None else ("physics", "reflector"):
        outcomes: dict[str, dict[str, torch.Tensor]] = {}
        for name in (before, after):
            policy = run.policy(name)
            actor = laplace_actor(policy)
            judge = reflector if protocol == "reflector" else None
            described = outcomes_env(run, config.tasks[0], "test", 1, judge, with_sim_state=True)
            taking_part = {"policy": policy} | ({} if judge is None else {"reflector": judge.reflector})
            about = recording(config, described, "evaluate", taking_part, policy=name, protocol=protocol)
            described.close()
            with RolloutWriter(folder.rollouts(f"evaluate_{protocol}_{name}"), **about, overwrite=True) as writer:
                outcomes[name] = {
                    task: physics_outcomes(
                        run,
                        actor,
                        task,
                        "test",
                        config.evaluate.episodes_per_task,
                        judge=judge,
                        writer=writer,
                        label=f"{name}, {protocol} stops",
                    )
                    for task in config.tasks
                }
        for name, per_task in outcomes.items():
            _log(folder, protocol, name, "all", torch.cat(list(per_task.values())))
            for task, success in per_task.items():
                _log(folder, protocol, name, task, success)
        for task in ("all", *config.tasks):
            pair = [
                torch.cat(list(o.values())) if task == "all" else o[task] for o in (outcomes[before], outcomes[after])
            ]
            test = paired_test(*pair)
            folder.log("evaluate", protocol=protocol, task=task, paired=True, **{k: float(v) for k, v in test.items()})


def _log(folder: RunFolder, protocol: str, policy: str, task: str, success: torch.Tensor) -> None:
    low, high = wilson_interval(int(success.sum()), len(success))
    folder.log(
        "evaluate",
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
