"""LOOP (World-Env Algorithm 1): rollouts, leave-one-out advantages, clipped updates of LoRA and heads.

``env="imagined"`` learns in the world model, ``env="tabletop"`` in the physics (the upper bound); nothing else changes.
Alone: ``python recipes/post_train.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import math
import time

import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from tqdm import tqdm

from config import PostTrain, WorldEnvConfig
from outcomes import greedy_outcomes, physics_outcomes
from parts import (
    exploring_actor,
    imagined_env,
    load_policy,
    load_reflector,
    load_world_model,
    physics_waves_env,
    read_contexts,
    recording,
    seed_everything,
)
from run_folder import RunFolder
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.metrics import HonestyAlarm, honesty
from worldenv_trl.objectives import LOOPLoss, rloo_advantage
from worldenv_trl.policies import laplace_actor
from worldenv_trl.record import RolloutWriter

_PATIENCE = 3  # iterations
_STUCK = (
    "warning: {}, iteration {}: for {} iterations the first update alone has moved the policy by more than max_kl={}, "
    "so nearly nothing is learned: the scale of a dimension may be too small for how far its mean moves "
    "(--scale-floor, --scale-share), or the learning rates too large"
)


def run(config: WorldEnvConfig, folder: RunFolder, source: str, target: str, models: str) -> None:
    """Improves checkpoint ``source`` in the world model and reflector of round ``models``; writes ``target``."""
    settings = config.post_train
    seed_everything(config, offset=50)
    policy = load_policy(folder, source, "sft")
    if not policy.config.lora_rank:
        policy.add_lora(settings.lora_rank)
    actor = exploring_actor(config, policy, settings.scale_factor)

    shape = [settings.groups, settings.group_size]
    if settings.env == "imagined":
        imagination = load_world_model(folder, models), load_reflector(folder, models), read_contexts(folder)
        env = imagined_env(config, *imagination, shape)
        judges = {"world_model": imagination[0], "reflector": imagination[1]}
    else:
        imagination, env, judges = None, physics_waves_env(config, *shape), {}
    collector = GroupCollector(
        env,
        actor,
        groups_per_batch=settings.groups,
        total_groups=settings.iterations * settings.groups,
        group_size=settings.group_size,
    )
    loss = LOOPLoss(actor, clip_epsilon=settings.clip_epsilon, ratio_level=settings.ratio_level, functional=False)
    heads = list(policy.head_parameters())
    lora = list(policy.lora_parameters())
    optimizer = torch.optim.AdamW(
        [{"params": lora, "lr": settings.lora_lr}, {"params": heads, "lr": settings.head_lr}], weight_decay=0.0
    )
    full_rates = [group["lr"] for group in optimizer.param_groups]
    # Single iterations are noisy: what is probed and saved is a running mean of the weights they reach.
    mean = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(settings.averaging))
    mean_actor = laplace_actor(mean.module)

    probed = _probed_iterations(settings)
    alarm = HonestyAlarm(len(probed), false_alarm_rate=settings.false_alarm_rate) if probed and imagination else None
    progress, started = tqdm(collector, total=settings.iterations, desc=target, unit="it"), time.monotonic()
    stuck = 0
    for iteration, wave in enumerate(progress):
        factor = _rate_factor(iteration, settings)
        for group, rate in zip(optimizer.param_groups, full_rates, strict=True):
            group["lr"] = factor * rate
        returns = wave["returns"][..., 0]  # [G, N]
        advantage = rloo_advantage(returns)
        if settings.standardize:
            advantage = advantage / advantage.std().clamp_min(1e-6)
        wave[keys.ADVANTAGE] = advantage[..., None, None].expand(*wave.shape, 1)
        decisions = wave.select(
            keys.IMAGE,
            keys.STATE,
            keys.TASK_ID,
            keys.CHUNK,
            keys.LOG_PROBS,
            keys.ADVANTAGE,
            ("next", keys.STEP_MASK),
            keys.MASK,
        )[wave[keys.MASK]]
        decisions[keys.STEP_MASK] = decisions["next", keys.STEP_MASK]
        total_steps = decisions[keys.STEP_MASK].sum()  # of Eq. 5: decisions that teach nothing count, too
        decisions = decisions[decisions[keys.ADVANTAGE].squeeze(-1) != 0]
        about = {}
        if iteration in (0, settings.iterations - 1):  # of the weights that collected it
            about = recording(config, env, target, {"policy": policy} | judges, iteration=iteration)
        metrics = _update(decisions, total_steps, loss, optimizer, [lora, heads], settings)
        stuck = _stuck(stuck, metrics)
        if stuck == _PATIENCE:
            progress.write(_STUCK.format(target, iteration, stuck, settings.max_kl))
        if about:
            parts = wave.reshape(-1).split(settings.minibatch_size)
            wave.update(torch.cat([loss.ratios(part) for part in parts]).reshape(wave.shape))
        mean.update_parameters(policy)
        collector.update_policy_weights_()

        metrics |= _wave_metrics(wave, returns)
        metrics["iteration_seconds"], started = time.monotonic() - started, time.monotonic()
        if iteration in probed:
            metrics |= _probe(config, mean_actor, imagination, alarm)
            metrics["probe_seconds"], started = time.monotonic() - started, time.monotonic()
            if metrics.get("honesty_alarm"):
                progress.write(_warning(target, iteration, metrics))
        folder.log(target, step=iteration, **metrics)
        progress.set_postfix({k: f"{metrics[k]:.3f}" for k in ("return", "kl_approx", "real_success") if k in metrics})
        if about:
            with RolloutWriter(folder.rollouts(f"{target}_{iteration:03d}"), **about, overwrite=True) as writer:
                writer.write(wave)
    collector.shutdown()
    mean.module.save_pretrained(folder.checkpoint(target))


def _rate_factor(iteration: int, settings: PostTrain) -> float:
    """Linear warm-up, then half a cosine down to a tenth."""
    warmup = (iteration + 1) / (settings.warmup_iterations + 1)
    return min(warmup, 0.55 + 0.45 * math.cos(math.pi * iteration / settings.iterations))


def _update(decisions, total_steps, loss, optimizer, parameter_groups, settings) -> dict[str, float]:
    """K epochs of clipped updates on one batch of decisions, stopped when the policy has moved too far."""
    sums: dict[str, float] = {}
    count, stopped = 0, False
    for _ in range(settings.epochs):
        for rows in torch.randperm(len(decisions)).split(settings.minibatch_size):
            batch = decisions[rows]
            # A minibatch stands for its share of the whole batch.
            batch["total_steps"] = (total_steps * len(rows) / len(decisions)).expand(len(rows), 1)
            out = loss(batch)
            if out["kl_approx"].item() > settings.max_kl:
                stopped = True
                break
            optimizer.zero_grad()
            out["loss_objective"].backward()
            for parameters in parameter_groups:
                torch.nn.utils.clip_grad_norm_(parameters, settings.max_grad_norm)
            optimizer.step()
            count += 1
            for name, value in out.items():
                if value.numel() == 1:
                    sums[name] = sums.get(name, 0.0) + value.item()
        if stopped:
            break
    return {name: value / max(count, 1) for name, value in sums.items()} | {"updates": count, "kl_stop": float(stopped)}


def _stuck(before: int, metrics: dict[str, float]) -> int:
    """Iterations in a row, this one included, whose first update alone went too far."""
    return before + 1 if metrics["kl_stop"] and metrics["updates"] <= 1 else 0


def _wave_metrics(wave, returns) -> dict[str, float]:
    mask = wave[keys.MASK]
    ended = (wave["next", "terminated"].squeeze(-1) & mask).any(-1)
    metrics = {
        "return": returns.mean().item(),
        "stopped": ended.float().mean().item(),
        "steps": (wave["next", keys.STEP_MASK] & mask[..., None]).sum((-2, -1)).float().mean().item(),
        "degenerate_groups": (returns.std(-1) < 1e-3).float().mean().item(),
    }
    tasks = wave[keys.TASK_ID][..., 0, 0][:, 0]
    for task in tasks.unique().tolist():
        metrics[f"stopped_task_{task}"] = ended[tasks == task].float().mean().item()
    return metrics


def _probed_iterations(settings: PostTrain) -> set[int]:
    """Every ``probe_every``-th iteration, the first and the last."""
    if not settings.probe_every:
        return set()
    return {*range(0, settings.iterations, settings.probe_every), settings.iterations - 1}


def _probe(config, actor, imagination, alarm: HonestyAlarm | None) -> dict[str, float]:
    """Greedy success on training contexts: in the physics (the reflector not involved) and in imagination."""
    count = config.post_train.probe_contexts
    if imagination is None:
        indices = torch.linspace(0, config.train_states - 1, min(count, config.train_states)).long().tolist()
        real = [physics_outcomes(config, actor, task, "train", len(indices), indices=indices) for task in config.tasks]
        return {"real_success": torch.cat(real).float().mean().item(), "probe_episodes": len(torch.cat(real))}
    real, imagined = greedy_outcomes(config, actor, *imagination, count)
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
    }


def _warning(target: str, iteration: int, metrics: dict[str, float]) -> str:
    return (
        f"warning: {target}, iteration {iteration}: imagined success has risen by {100 * metrics['imagined_rise']:.1f} "
        f"points since the first probes, real success by {100 * metrics['real_rise']:+.1f} (now "
        f"{100 * metrics['imagined_success']:.0f} % and {100 * metrics['real_success']:.0f} % of "
        f"{metrics['probe_episodes']} training contexts, p = {metrics['honesty_p']:.2g}): "
        "the policy may be learning the world model's errors; training goes on"
    )


if __name__ == "__main__":
    from world_env import run_single

    run_single("post_train")
