"""The honest probe of a post-training run: the policy in the physics, looked at and never learned from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict.nn import TensorDictModuleBase

from config import PostTrain
from imagination import Imagination
from outcomes import greedy_outcomes, physics_outcomes
from run import Run
from worldenv_trl.metrics import HonestyAlarm, honesty


def probed_iterations(settings: PostTrain) -> set[int]:
    """Every ``probe_every``-th iteration, the first and the last."""
    if not settings.probe_every:
        return set()
    return {*range(0, settings.iterations, settings.probe_every), settings.iterations - 1}


def probe(
    run: Run, actor: TensorDictModuleBase, imagination: Imagination | None, alarm: HonestyAlarm | None
) -> dict[str, float]:
    """Greedy success on training contexts: in the physics (the reflector not involved) and in imagination."""
    config = run.config
    count = config.post_train.probe_contexts
    if imagination is None or alarm is None:  # one comes with the other
        indices = torch.linspace(0, config.train_states - 1, min(count, config.train_states)).long().tolist()
        real = {
            task: physics_outcomes(run, actor, task, "train", len(indices), indices=indices) for task in config.tasks
        }
        outcomes = torch.cat([*real.values()])
        found = {"real_success": outcomes.float().mean().item(), "probe_episodes": len(outcomes)}
        return found | by_task("real_success", real)
    real, imagined = greedy_outcomes(run, actor, imagination, count)
    both = [torch.cat([*each.values()]) for each in (imagined, real)]
    report, watch = honesty(*both), alarm.update(*both)
    return {
        "real_success": report["real"],
        "imagined_success": report["imagined"],
        "imagined_precision": report["precision"],
        "imagined_recall": report["recall"],
        "probe_episodes": report["n"],
        "honesty_alarm": float(watch.fired),
        "honesty_p": watch.p_value,
        "imagined_rise": watch.imagined_rise,
        "real_rise": watch.real_rise,
        **by_task("real_success", real),
        **by_task("imagined_success", imagined),
    }


def by_task(name: str, outcomes: Mapping[str, torch.Tensor]) -> dict[str, float]:
    """``<name>_<task>``, the mean of each task's outcomes [K]."""
    return {f"{name}_{task}": each.float().mean().item() for task, each in outcomes.items()}


def warning(target: str, source: str, iteration: int, metrics: dict[str, float], tasks: Sequence[str]) -> str:
    worlds = [{task: metrics.get(f"{name}_success_{task}", 0.0) for task in tasks} for name in ("imagined", "real")]
    worst = max(tasks, key=lambda task: worlds[0][task] - worlds[1][task])
    return (
        f"warning: {target}, iteration {iteration}: imagined success has risen by {100 * metrics['imagined_rise']:.1f} "
        f"points since the first probes, real success by {100 * metrics['real_rise']:+.1f} (now "
        f"{100 * metrics['imagined_success']:.0f} % and {100 * metrics['real_success']:.0f} % of "
        f"{metrics['probe_episodes']} training contexts, p = {metrics['honesty_p']:.2g}; furthest apart on {worst}, "
        f"{100 * worlds[0][worst]:.0f} % and {100 * worlds[1][worst]:.0f} %): "
        "the policy may be learning the world model's errors; training goes on; where this is "
        f"still said at its end keep checkpoints/{source}"
    )
