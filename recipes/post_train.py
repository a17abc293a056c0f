"""LOOP (World-Env Algorithm 1): rollouts, leave-one-out advantages, clipped updates of adapters and heads, or all.

``env="imagined"`` learns in the world model, ``env="tabletop"`` in the physics (the upper bound); nothing else changes.
Alone: ``python recipes/post_train.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase

import processes
from averaging import RunningMean
from data_parallel import DataParallel, WholeOptimizer
from holding import Hold, all_held
from imagination import Imagination
from physics import exploring_actor, recording
from probes import probe, probed_iterations, warning
from resumable import Resumable
from run import Run
from seeds import another_draw
from stages import run_alone
from updates import PATIENCE, STUCK, rate_factor, ratios, stuck, update
from waves import Waves
from worldenv_trl import keys
from worldenv_trl.envs import FramesAside
from worldenv_trl.metrics import HonestyAlarm
from worldenv_trl.objectives import LOOPLoss, rloo_advantage
from worldenv_trl.policies import Policy, TokenPolicy, policy_actor
from worldenv_trl.record import RolloutWriter


def collected_returns(wave: TensorDictBase) -> torch.Tensor:
    """The return ``[G, N]`` of each rollout of a wave ``[G, N, T]``: what the env gave."""
    return wave["returns"][..., 0]


def post_train(
    run: Run,
    source: str,
    target: str,
    models: str,
    *,
    returns_of: Callable[[TensorDictBase], torch.Tensor] = collected_returns,
    watch: Callable[[int, Policy], None] | None = None,
) -> None:
    """Improves checkpoint ``source`` in the world model and reflector of round ``models``; writes ``target``, where
    every task is held a copy.

    Keyword Args:
        returns_of: from a wave ``[G, N, T]`` to the returns ``[G, N]`` that are learned from.
        watch: called before the first iteration and after each one with the number of iterations done and the policy
            that would be saved now, which it must leave as it is, like torch's random numbers.
    """
    config, settings = run.config, run.config.post_train
    learns = settings.env == "imagined" and not all_held(run, models)
    imagination = Imagination.load(run, models) if learns else None
    hold = Hold(run, source, models, imagination) if settings.hold else None
    run.seed_everything(target, another_draw(settings.draw))
    policy = run.policy(source)
    if hold is not None and hold.everything:
        if watch is not None:
            processes.on_main(lambda: watch(0, policy))
        if processes.is_main():
            policy.save_pretrained(run.folder.checkpoint(target))
        return
    groups = policy.post_training_parameters(settings.lora_rank)
    rates = {name: settings.head_lr if name == "heads" else settings.lora_lr for name in groups}
    for name in [name for name, rate in rates.items() if not rate]:
        for parameter in groups.pop(name):
            parameter.requires_grad_(False)
    actor = exploring_actor(config, policy, settings.scale_factor, settings.noise)

    waves = Waves(run, target, imagination, actor)
    read = [*policy.in_keys, *([keys.TOKENS] if isinstance(policy, TokenPolicy) else [])]
    read += [key for key in (keys.TOKEN_IS_PAD,) if key in actor.out_keys]

    def make_loss(part: Policy) -> LOOPLoss:
        scored = actor if part is policy else exploring_actor(config, part, settings.scale_factor, settings.noise)
        loss = LOOPLoss(
            scored,
            clip_epsilon=settings.clip_epsilon,
            ratio_level=settings.ratio_level,
            reference_coef=settings.hold,
            functional=False,
        )
        if isinstance(part, TokenPolicy):
            loss.set_keys(action=keys.TOKENS)
        return loss

    learner = DataParallel(policy, make_loss, config.parallel)
    groups = {name: learner.trained(parameters) for name, parameters in groups.items()}
    optimizer = torch.optim.AdamW(
        [{"params": parameters, "lr": rates[name]} for name, parameters in groups.items()],
        betas=(settings.momentum, 0.999),
        weight_decay=0.0,
    )
    full_rates = [group["lr"] for group in optimizer.param_groups]
    # Single iterations are noisy: what is probed and saved is a running mean of the weights.
    mean = RunningMean(policy, settings.averaging)
    averaged = mean.policy
    mean_actor = policy_actor(averaged)

    probed, recorded = probed_iterations(settings), {0, settings.iterations - 1}
    alarm = HonestyAlarm(len(probed), false_alarm_rate=settings.false_alarm_rate) if probed and imagination else None
    counts = {"stuck": 0}
    learning: dict[str, Any] = {"collector": waves.collector, "optimizer": WholeOptimizer(optimizer)}
    learning |= {"mean": mean, "alarm": alarm, "counts": counts}
    left = Resumable(run, "iterations", settings.iterations, **learning)
    learner.scatter()
    waves.record_next(left.step in recorded)
    if watch is not None and not left.step:
        processes.on_main(lambda: watch(0, averaged))
    collected, progress, started = iter(waves), left.bar(target, "it"), time.monotonic()
    for iteration in progress:
        wave, mine = next(collected)
        factor = rate_factor(iteration, settings)
        for group, rate in zip(optimizer.param_groups, full_rates, strict=True):
            group["lr"] = factor * rate
        returns = processes.gathered(returns_of(mine))  # [G, N], of all processes
        advantage = rloo_advantage(returns)
        if settings.standardize:
            advantage = advantage / advantage.std().clamp_min(1e-6)
        if hold is not None:
            own = hold.groups(mine)
            held = processes.gathered(own)
            advantage = advantage * ~held[:, None]
            mine[keys.HELD] = _at_decisions(own[:, None], mine)
        mine[keys.ADVANTAGE] = _at_decisions(processes.own_rows_of(advantage), mine)
        about = {}
        if iteration in recorded and processes.is_main():  # of the weights that collected it
            about = recording(config, waves.env, target, {"policy": policy} | waves.judges, iteration=iteration)
        refer = None if hold is None else hold.refer
        metrics = update(mine, read, learner, optimizer, list(groups.values()), settings, refer)
        learner.gather()
        counts["stuck"] = stuck(counts["stuck"], metrics)
        if counts["stuck"] == PATIENCE and processes.is_main():
            progress.write(STUCK.format(target, iteration, PATIENCE, settings.max_kl))
        if about:
            if wave is not mine:
                wave[keys.ADVANTAGE] = _at_decisions(advantage, wave)
            wave.update(ratios(wave, read, make_loss(policy)))
            _write(run, f"{target}_{iteration:03d}", about, wave, waves.aside)
        mean.update()
        waves.update_policy_weights_()

        metrics |= _wave_metrics(mine, returns, config.tasks)
        if hold is not None:
            metrics["held_groups"] = held.float().mean().item()
        metrics["iteration_seconds"], started = time.monotonic() - started, time.monotonic()
        if iteration in probed:
            metrics |= processes.on_main(lambda: probe(run, mean_actor, imagination, alarm))
            metrics["probe_seconds"], started = time.monotonic() - started, time.monotonic()
            if metrics.get("honesty_alarm") and processes.is_main():
                progress.write(warning(target, source, iteration, metrics, config.tasks))
        run.folder.log(target, step=iteration, **metrics)
        progress.set_postfix({k: f"{metrics[k]:.3f}" for k in ("return", "kl_approx", "real_success") if k in metrics})
        del wave, mine  # before the next ones are collected
        if watch is not None:
            processes.on_main(partial(watch, iteration + 1, averaged))
            started = time.monotonic()  # the next iteration's
        waves.record_next(iteration + 1 in recorded)
    waves.shutdown()
    learner.close()
    if processes.is_main():
        averaged.save_pretrained(run.folder.checkpoint(target))


def _at_decisions(advantage: torch.Tensor, wave: TensorDictBase) -> torch.Tensor:
    """[G, N, T, 1] of advantages [G, N], or of something of each group [G, 1]: the same at every decision."""
    return advantage[..., None, None].expand(*wave.shape, 1)


def _write(run: Run, name: str, about: dict, wave: TensorDictBase, aside: FramesAside | None) -> None:
    """The wave and, group by group, what imagination painted."""
    frames = None if aside is None else aside.frames()
    with RolloutWriter(run.folder.rollouts(name), **about, overwrite=True) as writer:
        for group in range(wave.shape[0]):
            part = wave[group : group + 1].clone(False)
            if frames is not None:
                part["next"] = part["next"].clone(False).update(frames[group : group + 1].contiguous())
            writer.write(part)
            if aside is not None:
                aside.release()


def _wave_metrics(wave: TensorDictBase, returns: torch.Tensor, tasks: tuple[str, ...]) -> dict[str, float]:
    """Of the waves of all processes."""
    mask = wave[keys.MASK]
    ended = processes.gathered((wave["next", "terminated"].squeeze(-1) & mask).any(-1))
    steps = processes.gathered((wave["next", keys.STEP_MASK] & mask[..., None]).sum((-2, -1)))
    metrics = {
        "return": returns.mean().item(),
        "stopped": ended.float().mean().item(),
        "steps": steps.float().mean().item(),
        "degenerate_groups": (returns.std(-1) < 1e-3).float().mean().item(),
    }
    number = processes.gathered(wave[keys.TASK_ID][..., 0, 0][:, 0])
    for task in number.unique().tolist():
        metrics[f"stopped_{tasks[task]}"] = ended[number == task].float().mean().item()
    return metrics


if __name__ == "__main__":
    run_alone("post_train", post_train)
