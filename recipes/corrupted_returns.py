"""Returns of the physics, corrupted on purpose: what LOOP pays for what imagination gets wrong.

``post_train(run, "sft", "post_train", "", returns_of=CorruptedReturns(Corruption("noise", 0.6), seed=0))``

With y in {0, 1} the success of a rollout, p the rate of success of its context and r the correlation of y with what is
seen of it, within the context:

``noise``: a calibrated probability x, E[y | x] = x. Calibration makes Cov(x, y) = Var(x), so
    r^2 = Var(x) / (p (1 - p)): x ~ Beta(p s, (1 - p) s) with s = 1 / r^2 - 1 has that variance. By conjugacy x given y
    is Beta(p s + y, (1 - p) s + 1 - y), from which it is drawn.
``guess``: a sharp 0 or 1, not calibrated: y with probability r, else a draw of its own from Bernoulli(p). A draw from
    Bernoulli(x) of the calibrated x would correlate r^2 alone.
``optimism``: a failure looks like a success with probability b, a success always like one:
    r^2 = p (1 - b) / (p + (1 - p) b).

p is the share of a group that succeeds; a group whose N rollouts all end alike counts as one of half a rollout in N, so
that it can deceive, as it does in imagination. The b of ``optimism`` at a given r is that of the task's rate in the
wave, one for all its contexts. All this holds for endless groups: in groups of 8
:func:`~worldenv_trl.metrics.advantage_correlation`, by which r is measured elsewhere, is .03 higher for noise and, as
groups that look successful throughout count as 0, .03 to .1 lower for optimism. Compare what was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDictBase

from worldenv_trl import keys

KINDS = ("none", "noise", "guess", "optimism")


@dataclass(frozen=True)
class Corruption:
    """How the returns that LOOP sees differ from success."""

    kind: str = "none"
    """``none``, ``noise`` (a calibrated probability), ``guess`` (sharp, and wrong at times) or ``optimism`` (failures
    that look like successes)."""
    correlation: float = 1.0
    """Within a group, of what LOOP sees with the truth; of ``optimism`` unless ``false_success`` is given."""
    false_success: tuple[float, ...] = ()
    """Of ``optimism``: probability that a failure looks like a success, of each task or one for all."""
    by_context: bool = False
    """Of ``false_success``: the means of the probabilities that contexts have of their own, the same in every wave:
    Beta(b, 1 - b), mostly near 0 or 1."""


def check_corruption(corruption: Corruption, num_tasks: int) -> None:
    """Raises ``ValueError`` for what cannot be done, in the words of its fields."""
    kind, given = corruption.kind, corruption.false_success
    if kind not in KINDS:
        raise ValueError(f"corruption.kind must be one of {', '.join(KINDS)}, got {kind!r}")
    if not 0 < corruption.correlation <= 1:
        raise ValueError(f"corruption.correlation must lie in (0, 1], got {corruption.correlation}")
    if kind == "none" and corruption.correlation < 1:
        raise ValueError(f"corruption.correlation={corruption.correlation} needs a kind: {', '.join(KINDS[1:])}")
    if given and kind != "optimism":
        raise ValueError(f"corruption.false_success is of the kind optimism, got kind={kind!r}")
    if given and corruption.correlation < 1:
        raise ValueError("corruption.correlation and corruption.false_success say the same: give one of them")
    if kind == "optimism" and not given and corruption.correlation == 1:
        raise ValueError("corruption.kind=optimism needs a correlation below 1, or false_success")
    if given and (len(given) not in (1, num_tasks) or not all(0 <= value <= 1 for value in given)):
        raise ValueError(
            f"corruption.false_success must be one probability or one for each of {num_tasks} tasks, got {given}"
        )
    if corruption.by_context and not given:
        raise ValueError("corruption.by_context needs false_success")


class CorruptedReturns:
    """From a wave of the physics to the returns that LOOP learns from.

    Args:
        corruption: checked, see :func:`check_corruption`.
        seed: of numbers of its own: what else is drawn stays as it is.
    """

    def __init__(self, corruption: Corruption, seed: int) -> None:
        self.corruption, self.seed = corruption, seed
        self._generator = np.random.default_rng([seed, KINDS.index(corruption.kind)])

    def __call__(self, wave: TensorDictBase) -> torch.Tensor:
        """``[G, N]`` float32 in [0, 1], for a wave ``[G, N, T]`` whose returns are 1 for success and 0 otherwise."""
        returns = wave["returns"][..., 0]
        settings, success = self.corruption, returns.numpy() > 0.5  # [G, N]
        if settings.kind == "none" or (settings.correlation == 1 and not settings.false_success):
            return returns
        if settings.kind == "optimism":
            seen = look_successful(success, self._false_success(wave, success), self._generator)
        else:
            draw = calibrated_probabilities if settings.kind == "noise" else guesses
            seen = draw(success, settings.correlation, self._generator)
        return torch.as_tensor(seen, dtype=returns.dtype)

    def _false_success(self, wave: TensorDictBase, success: np.ndarray) -> np.ndarray:
        """``[G, 1]``: of each group."""
        settings = self.corruption
        task = wave[keys.TASK_ID][:, 0, 0, 0].numpy()
        if not settings.false_success:
            # Over the contexts of a task, for failures in contexts that always fail deceive as well.
            tasks = {number: clamped_rate(success[task == number].reshape(1, -1))[0, 0] for number in np.unique(task)}
            return np.array([[false_success_at(tasks[number], settings.correlation)] for number in task])
        given = settings.false_success
        means = np.array([given[number if len(given) > 1 else 0] for number in task])
        if settings.by_context:
            context = wave[keys.CONTEXT_ID][:, 0, 0, 0].tolist()
            means = np.array([self._of_context(mean, number) for mean, number in zip(means, context, strict=True)])
        return means[:, None]

    def _of_context(self, mean: float, context: int) -> float:
        if mean in (0.0, 1.0):
            return mean
        return float(np.random.default_rng([self.seed, context]).beta(mean, 1 - mean))


def clamped_rate(success: np.ndarray) -> np.ndarray:
    """``[G, 1]``: share of each group ``[G, N]`` that succeeds, at least half a rollout away from none and from all."""
    half = 0.5 / success.shape[-1]
    return success.mean(-1, keepdims=True).clip(half, 1 - half)


def calibrated_probabilities(success: np.ndarray, correlation: float, generator: np.random.Generator) -> np.ndarray:
    """``[G, N]``: probabilities of success that correlate with ``success`` (bool ``[G, N]``), in (0, 1) below 1."""
    if correlation == 1:
        return success.astype(float)
    strength, rate = 1 / correlation**2 - 1, clamped_rate(success)
    return generator.beta(rate * strength + success, (1 - rate) * strength + ~success)


def guesses(success: np.ndarray, correlation: float, generator: np.random.Generator) -> np.ndarray:
    """``[G, N]`` bool: the truth with probability ``correlation``, else drawn by the group's rate alone."""
    known = generator.random(success.shape) < correlation
    return np.where(known, success, generator.random(success.shape) < clamped_rate(success))


def look_successful(success: np.ndarray, false_success: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """``[G, N]`` bool: successes, and failures with probability ``false_success`` (``[G, 1]``)."""
    return success | (generator.random(success.shape) < false_success)


def optimistic_correlation(rate: float, false_success: float) -> float:
    """Of success, at a rate in (0, 1), with what looks like it."""
    return (rate * (1 - false_success) / (rate + (1 - rate) * false_success)) ** 0.5


def false_success_at(rate: float, correlation: float) -> float:
    """The probability that a failure looks like a success at which :func:`optimistic_correlation` is so much."""
    return rate * (1 - correlation**2) / (rate + (1 - rate) * correlation**2)
