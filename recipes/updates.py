"""LOOP's update: clipped steps on one batch of decisions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase

from config import PostTrain
from worldenv_trl import keys
from worldenv_trl.devices import device_of, to_device
from worldenv_trl.language import instructions_of
from worldenv_trl.objectives import LOOPLoss
from worldenv_trl.row_texts import row_texts

PATIENCE = 3  # iterations
_PIXELS = 256 * 3 * 64 * 64  # whose activations fit into memory together
_PIXELS_ON_GPU = 16 * _PIXELS
STUCK = (
    "warning: {}, iteration {}: for {} iterations the first update alone has moved the policy by more than max_kl={}, "
    "so nearly nothing is learned: the scale of a dimension may be too small for how far its mean moves "
    "(--scale-floor, --scale-share), or the learning rates too large"
)


def rate_factor(iteration: int, settings: PostTrain) -> float:
    """Linear warm-up, then half a cosine down to a tenth."""
    warmup = (iteration + 1) / (settings.warmup_iterations + 1)
    return min(warmup, 0.55 + 0.45 * math.cos(math.pi * iteration / settings.iterations))


def update(
    wave: TensorDictBase,
    in_keys: Sequence[NestedKey],
    loss: LOOPLoss,
    optimizer: torch.optim.Optimizer,
    parameter_groups: Sequence[list[torch.nn.Parameter]],
    settings: PostTrain,
) -> dict[str, float]:
    """K epochs of clipped updates on the decisions of a wave, stopped when the policy has moved too far.

    Args:
        wave: [G, N, T] with advantages, on whatever device; what is learned from goes to the loss's, once.
        in_keys: what the policy reads.

    Decisions without an advantage teach nothing and are left out, but count among Eq. 5's steps. If there is no other
    one, nothing moves: the optimiser's moments alone would.
    """
    mask = wave[keys.MASK]
    informative = mask & (wave[keys.ADVANTAGE].squeeze(-1) != 0)
    if not informative.any():
        return {"updates": 0, "kl_stop": 0.0}
    learned = (keys.CHUNK, keys.LOG_PROBS, keys.ADVANTAGE, ("next", keys.STEP_MASK), keys.MASK)
    # Flat first: a mask that leaves a whole block of texts without one makes tensordict stumble over the empty stack.
    decisions = wave.select(*in_keys, *learned).reshape(-1)[informative.flatten()]
    decisions = to_device(decisions, device_of(loss))
    decisions[keys.STEP_MASK] = decisions["next", keys.STEP_MASK]
    decisions.set(keys.INSTRUCTION, row_texts(instructions_of(decisions)))  # cheap to index, minibatch by minibatch
    total_steps = (wave["next", keys.STEP_MASK] & mask.unsqueeze(-1)).sum().to(decisions[keys.CHUNK].device)
    sums: dict[str, float] = {}
    count, stopped = 0, False
    for _ in range(settings.epochs):
        for rows in torch.randperm(len(decisions)).split(settings.minibatch_size):
            batch = decisions[rows]
            # A minibatch stands for its share of the whole batch.
            batch["total_steps"] = (total_steps * len(rows) / len(decisions)).expand(len(rows), 1)
            optimizer.zero_grad()
            figures = _backward(loss, batch)
            if figures["kl_approx"] > settings.max_kl:
                stopped = True
                break
            for parameters in parameter_groups:
                torch.nn.utils.clip_grad_norm_(parameters, settings.max_grad_norm)
            optimizer.step()
            count += 1
            for name, value in figures.items():
                sums[name] = sums.get(name, 0.0) + value
        if stopped:
            break
    return {name: value / max(count, 1) for name, value in sums.items()} | {"updates": count, "kl_stop": float(stopped)}


def _backward(loss: LOOPLoss, batch: TensorDictBase) -> dict[str, float]:
    """Gradients and figures of a minibatch, so many rows at a time as fit: the losses of the parts add up to that of
    the whole."""
    pixels = sum(value[0].numel() for value in batch["observation"].values() if value.dtype == torch.uint8)
    steps, figures = batch[keys.STEP_MASK].sum(), dict[str, float]()
    for part in batch.split(rows_at_once(pixels, batch[keys.CHUNK].device.type)):
        out = loss(part)
        out["loss_objective"].backward()
        names = [name for name, value in out.items() if value.numel() == 1]
        share, *values = torch.stack([part[keys.STEP_MASK].sum() / steps, *(out[name] for name in names)]).tolist()
        for name, value in zip(names, values, strict=True):
            weight = 1.0 if name == "loss_objective" else share
            figures[name] = figures.get(name, 0.0) + weight * value
    return figures


def rows_at_once(pixels: int, device_type: str) -> int:
    """Decisions whose activations are there together, each of so many numbers of images."""
    return max(16, (_PIXELS if device_type == "cpu" else _PIXELS_ON_GPU) // max(pixels, 1))


def ratios(wave: TensorDictBase, in_keys: Sequence[NestedKey], loss: LOOPLoss) -> TensorDictBase:
    """:meth:`LOOPLoss.ratios` of a wave [G, N, T], some decisions at a time; on the wave's device."""
    names = {*in_keys, *loss.in_keys, ("next", keys.STEP_MASK), keys.MASK}
    parts = (to_device(part, device_of(loss)) for part in wave.select(*names, strict=False).reshape(-1).split(64))
    return to_device(torch.cat([loss.ratios(part) for part in parts]), wave[keys.CHUNK].device).reshape(wave.shape)


def stuck(before: int, metrics: dict[str, float]) -> int:
    """Iterations in a row, this one included, whose first update alone went too far."""
    return before + 1 if metrics["kl_stop"] and metrics["updates"] <= 1 else 0
