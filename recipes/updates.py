"""LOOP's update: clipped steps on one batch of decisions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase

import processes
from config import PostTrain
from data_parallel import DataParallel
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
    learner: DataParallel,
    optimizer: torch.optim.Optimizer,
    parameter_groups: Sequence[list[torch.nn.Parameter]],
    settings: PostTrain,
    refer: Callable[[TensorDictBase], None] | None = None,
) -> dict[str, float]:
    """K epochs of clipped updates on the decisions of a wave, stopped when the policy has moved too far.

    Args:
        wave: [G, N, T] with advantages, on whatever device; what is learned from goes to the policy's, once. Of several
            processes each has groups of its own, and a minibatch is theirs together.
        in_keys: what the policy reads, and the tokens of one that acts by tokens.
        learner: of a :class:`LOOPLoss`, whose minibatches add up.
        refer: writes what a reference policy does at the decisions ``[M]`` that are learned from, of a wave that says
            which are held.

    Decisions that have no advantage and are not held teach nothing and are left out, but count among Eq. 5's steps. If
    there is no other one, nothing moves: the optimiser's moments alone would.
    """
    mask = wave[keys.MASK]
    informative = mask & (wave[keys.ADVANTAGE].squeeze(-1) != 0)
    if refer is not None:
        informative |= mask & wave[keys.HELD].squeeze(-1)
    counts = processes.gathered_values(int(informative.sum()))
    if not any(counts):
        return {"updates": 0, "kl_stop": 0.0}
    learned: list[NestedKey] = [keys.CHUNK, keys.LOG_PROBS, keys.ADVANTAGE, ("next", keys.STEP_MASK), keys.MASK]
    learned += [] if refer is None else [keys.HELD]
    chosen = informative.flatten()
    if not counts[processes.rank()]:
        chosen = torch.arange(1)  # there must be something to take the place of rows
    # Flat first: a mask that leaves a whole block of texts without one makes tensordict stumble over the empty stack.
    decisions = wave.select(*in_keys, *learned).reshape(-1)[chosen]
    decisions = to_device(decisions, device_of(learner.part))
    decisions[keys.STEP_MASK] = decisions["next", keys.STEP_MASK]
    decisions.set(keys.INSTRUCTION, row_texts(instructions_of(decisions)))  # cheap to index, minibatch by minibatch
    if refer is not None:
        refer(decisions)
    total_steps = (wave["next", keys.STEP_MASK] & mask.unsqueeze(-1)).sum().to(decisions[keys.CHUNK].device)
    total_steps = processes.total(total_steps)
    sums: dict[str, float] = {}
    count, stopped = 0, False
    for _ in range(settings.epochs):
        order = processes.agreed(torch.randperm(sum(counts)))  # also if a policy's dropout has drawn otherwise
        for rows in order.split(settings.minibatch_size):
            shares = [rows[(rows >= end - own) & (rows < end)] - (end - own) for own, end in _ends(counts)]
            optimizer.zero_grad()
            # A minibatch stands for its share of the whole batch.
            figures = _backward(learner, decisions, shares, total_steps * len(rows) / sum(counts))
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


def _ends(counts: Sequence[int]) -> list[tuple[int, int]]:
    """How many decisions each process has, and where its own end among those of all."""
    return list(zip(counts, itertools.accumulate(counts), strict=True))


def _backward(
    learner: DataParallel, decisions: TensorDictBase, shares: Sequence[torch.Tensor], total_steps: torch.Tensor
) -> dict[str, float]:
    """Gradients and figures of a minibatch, so many rows at a time as fit: the losses of the parts add up to that of
    the whole.

    Args:
        learner: see :func:`update`.
        decisions: [M], this process's.
        shares: rows of the minibatch, of the decisions of each process.
        total_steps: that the minibatch stands for.
    """
    at_once = rows_of(decisions)
    parts = list(shares[processes.rank()].split(at_once))
    # All take as many turns: gradients are exchanged in them.
    turns = max(-(-len(share) // at_once) for share in shares)
    mine = decisions[keys.STEP_MASK][shares[processes.rank()]].sum()
    steps, figures = processes.total(mine), dict[str, float]()
    for turn in range(turns):
        part = _part(decisions, parts[turn] if turn < len(parts) else parts[0][:0])
        part["total_steps"] = total_steps.expand(len(part), 1)
        with learner.accumulating(last=turn + 1 == turns):
            out = learner(part)
            learner.backward_sum(sum(value for name, value in out.items() if name.startswith("loss_")))
        names = [name for name, value in out.items() if value.numel() == 1]
        share, *values = torch.stack([part[keys.STEP_MASK].sum() / steps, *(out[name] for name in names)]).tolist()
        for name, value in zip(names, values, strict=True):
            weight = 1.0 if name.startswith("loss_") else share
            figures[name] = figures.get(name, 0.0) + weight * value
    sums = processes.total(torch.tensor([*figures.values()], dtype=torch.float64))
    return dict(zip(figures, sums.tolist(), strict=True))


def _part(decisions: TensorDictBase, rows: torch.Tensor) -> TensorDictBase:
    """Some rows of the decisions; where there is none, one that does not count."""
    if len(rows):
        return decisions[rows]
    blank = decisions[:1].clone()
    blank[keys.STEP_MASK] = torch.zeros_like(blank[keys.STEP_MASK])
    blank["next", keys.STEP_MASK] = blank[keys.STEP_MASK]
    return blank


def rows_of(decisions: TensorDictBase) -> int:
    """:func:`rows_at_once` of decisions [M] on their device."""
    pixels = sum(value[0].numel() for value in decisions["observation"].values() if value.dtype == torch.uint8)
    return rows_at_once(pixels, decisions[keys.CHUNK].device.type)


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
