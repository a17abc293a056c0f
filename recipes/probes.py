"""The honest probe of a post-training run: the policy in the physics, looked at and never learned from."""

from __future__ import annotations

from collections.abc import Sequence

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
        tasks = [physics_outcomes(run, actor, task, "train", len(indices), indices=indices) for task in config.tasks]
        real, numbers = torch.cat(tasks), torch.cat([torch.full([len(each)], n) for n, each in enumerate(tasks)])
        found = {"real_success": real.float().mean().item(), "probe_episodes": len(real)}
        return found | by_task("real_success", real, numbers, config.tasks)
    real, imagined, numbers = greedy_outcomes(run, actor, imagination, count)
    report = honesty(imagined, real)
    watch = alarm.update(imagined, real)
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
        **by_task("real_success", real, numbers, config.tasks),
        **by_task("imagined_success", imagined, numbers, config.tasks),
    }


def by_task(name: str, outcomes: torch.Tensor, numbers: torch.Tensor, tasks: Sequence[str]) -> dict[str, float]:
    """``<name>_<task>``, the mean of the outcomes [K] of each task that is among their task ids [K]."""
    return {
        f"{name}_{tasks[task]}": outcomes[numbers == task].float().mean().item() for task in numbers.unique().tolist()
    }


def warning(target: str, source: str, iteration: int, metrics: dict[str, float]) -> str:
    worlds = ("imagined_success", "real_success")
    tasks = [name.removeprefix("real_success_") for name in metrics if name.startswith("real_success_")]
    apart = {task: [metrics[f"{world}_{task}"] for world in worlds] for task in tasks}
    worst = max(tasks, key=lambda task: apart[task][0] - apart[task][1])
    return (
        f"warning: {target}, iteration {iteration}: imagined success has risen by {100 * metrics['imagined_rise']:.1f} "
        f"points since the first probes, real success by {100 * metrics['real_rise']:+.1f} (now "
        f"{100 * metrics['imagined_success']:.0f} % and {100 * metrics['real_success']:.0f} % of "
        f"{metrics['probe_episodes']} training contexts, p = {metrics['honesty_p']:.2g}; furthest apart on {worst}, "
        f"{100 * apart[worst][0]:.0f} % and {100 * apart[worst][1]:.0f} %): "
        "the policy may be learning the world model's errors; training goes on; where this is "
        f"still said at its end keep checkpoints/{source}"
    )
