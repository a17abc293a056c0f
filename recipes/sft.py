"""Supervised fine-tuning: L1 on action chunks, then the Laplace scale head alone (World-Env Eq. 8).

Alone: ``python recipes/sft.py improve --run-dir runs/improve``.
"""

from __future__ import annotations

import math
import warnings

import torch
from torchrl.objectives import BCLoss
from tqdm import trange

from config import WorldEnvConfig
from parts import seed_everything, task_instructions
from run_folder import RunFolder
from worldenv_trl import keys
from worldenv_trl.data import episodes_from_rollouts, policy_samples
from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor, likelihood_actor, random_shift
from worldenv_trl.record import read_rollouts


def run(config: WorldEnvConfig, folder: RunFolder) -> None:
    """Reads ``rollouts/demonstrations.mcap``, writes ``checkpoints/sft``."""
    settings = config.sft
    seed_everything(config, offset=10)
    episodes = episodes_from_rollouts(read_rollouts(folder.require_rollouts("demonstrations", "demonstrate")))
    samples = policy_samples(episodes, config.chunk_length)
    policy = OFTPolicy(
        OFTConfig.for_tasks(
            task_instructions(config),
            image_size=config.image_size,
            chunk_length=config.chunk_length,
            dim=settings.dim,
            depth=settings.depth,
        )
    )
    policy.fit_statistics(samples[keys.STATE], samples[keys.CHUNK])
    heads_and_backbone = [*policy.backbone_parameters(), *policy.loc_head_parameters()]
    loss = _behaviour_cloning(laplace_actor(policy), loss_function="l1")
    _train(loss, samples, heads_and_backbone, settings.steps, settings.lr, settings, folder, "l1")

    # Only the scale head moves from here on (World-Env section 4.1).
    policy.requires_grad_(False)
    scale_head = list(policy.scale_head_parameters())
    for parameter in scale_head:
        parameter.requires_grad_(True)
    loss = _behaviour_cloning(likelihood_actor(policy))
    _train(loss, samples, scale_head, settings.scale_steps, settings.scale_lr, settings, folder, "nll")
    policy.requires_grad_(True)
    policy.save_pretrained(folder.checkpoint("sft"))


def _behaviour_cloning(actor, **options) -> BCLoss:
    with warnings.catch_warnings():  # about its own annotations
        warnings.simplefilter("ignore", UserWarning)
        loss = BCLoss(actor, **options)
    loss.set_keys(action=keys.CHUNK, pad_mask=keys.ACTION_IS_PAD)
    return loss


def _train(loss, samples, parameters, steps, lr, settings, folder: RunFolder, name: str) -> None:
    optimizer = torch.optim.AdamW(parameters, lr=lr, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / max(steps, 1)))
    )
    progress = trange(steps, desc=f"sft {name}", unit="step")
    for step in progress:
        batch = samples[torch.randint(len(samples), (settings.batch_size,))]
        batch[keys.IMAGE] = random_shift(batch[keys.IMAGE], settings.shift_px)
        value = loss(batch)["loss_bc"]
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        if step % 50 == 0 or step == steps - 1:
            folder.log("sft", step=step, **{name: value.item()})
            progress.set_postfix(loss=f"{value.item():.4f}")


if __name__ == "__main__":
    from world_env import run_single

    run_single("sft")
