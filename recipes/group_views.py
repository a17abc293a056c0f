"""What the reflector makes of the rollouts of real groups, as they were and as they are imagined."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from tqdm import tqdm

from real_groups import RealGroups
from run import LATE
from worldenv_trl.data import Episodes, imagine_episodes, score_episodes
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.metrics import (
    Estimate,
    calibration_slope,
    cohen_kappa,
    expected_calibration_error,
    group_bootstrap,
    group_correlations,
    group_slope,
    judged,
    largest_scores,
    loop_returns,
    precision,
    recall,
)
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.world_models import WorldModel

REAL, AHEAD, IMAGINED, DREAMT = "real frames", "one chunk ahead", "imagined", "dreamt"


@dataclass(frozen=True)
class RuledReflector:
    """A reflector, and when it stops ``imagined`` and ``real`` rollouts."""

    reflector: Reflector
    rules: Mapping[str, StopRule]


@dataclass(frozen=True)
class View:
    """What is said of the G x N rollouts of some groups, [G, N] each."""

    returns: Tensor
    """As LOOP takes them: R where the rule stops the rollout, or at its last frame."""
    largest: Tensor
    """Largest R of the whole video."""
    end: Tensor
    """Frame of the return, int64."""
    stopped: Tensor
    """Whether the rule ever stops it, bool."""
    done: Tensor
    """Whether the physics reaches the goal by then, or at all in a rollout that is not stopped, bool."""
    success: Tensor
    """Whether the physics reaches the goal within the step limit, bool."""

    @property
    def correlations(self) -> Tensor:
        """Of returns and success inside each group, float64 [G]; NaN where the group is not mixed."""
        return group_correlations(self.returns, self.success)


def _over_all(figure: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda first, second: figure(first.flatten(-2), second.flatten(-2))


def _mean_correlation(values: Tensor, success: Tensor) -> Tensor:
    return group_correlations(values, success).nanmean(-1)


FIGURES: dict[str, tuple[Callable[[Tensor, Tensor], Tensor], str, str]] = {
    "r": (_mean_correlation, "returns", "success"),
    "r_stop": (_mean_correlation, "stopped", "success"),
    "r_largest": (_mean_correlation, "largest", "success"),
    "slope_within": (group_slope, "returns", "success"),
    "kappa": (_over_all(cohen_kappa), "stopped", "done"),
    "precision": (_over_all(precision), "stopped", "done"),
    "recall": (_over_all(recall), "stopped", "done"),
    "calibration_error": (_over_all(expected_calibration_error), "returns", "done"),
    "calibration_slope": (_over_all(calibration_slope), "returns", "done"),
}
"""Each of two entries of a :class:`View`, [*B, G, N] -> [*B]."""


def view(judge: RuledReflector, groups: RealGroups, episodes: Episodes, real: bool = False) -> View:
    """What is said of ``episodes``, the groups' own (``real``) or what was imagined of them."""
    world = "real" if real else "imagined"
    scores, alive = score_episodes(judge.reflector.for_world(world), episodes), episodes.alive
    stop = judge.rules[world].first(scores, alive)
    stopped, done = judged(stop, groups.reached, LATE[world])
    return View(
        returns=groups.grouped(loop_returns(scores, stop, alive)),
        largest=groups.grouped(largest_scores(scores, alive)),
        end=groups.grouped(torch.where(stopped, stop, episodes["length"].squeeze(-1))),
        stopped=groups.grouped(stopped),
        done=groups.grouped(done),
        success=groups.success,
    )


def figures(view: View, task_id: Tensor, rows: Tensor, resamples: int) -> dict[str, Estimate]:
    """Every one of :data:`FIGURES` for the groups ``rows`` (a mask [G]), with 95 % intervals over groups."""
    return {
        name: group_bootstrap(
            figure,
            *(getattr(view, entry)[rows] for entry in entries),
            strata=task_id[rows],
            resamples=resamples,
        )
        for name, (figure, *entries) in FIGURES.items()
    }


def mean_correlation(correlations: Tensor, task_id: Tensor, rows: Tensor, resamples: int) -> Estimate:
    """Mean of correlations [G] (or of their differences) over the groups ``rows`` (a mask) in which there is one."""
    return group_bootstrap(
        partial(torch.nanmean, dim=-1), correlations[rows], strata=task_id[rows], resamples=resamples
    )


def views(
    judge: RuledReflector, world_model: WorldModel, kinematics: ForwardKinematics, groups: RealGroups
) -> tuple[dict[str, View], Episodes | None]:
    """:data:`REAL`: what the reflector can tell; :data:`AHEAD`: every chunk imagined from real memory; and
    :data:`IMAGINED`: open loop. Also the episodes one chunk ahead [G * N], for :func:`curve`.

    Where imagination's judge looks at no video, nothing is imagined: there are :data:`REAL` and :data:`IMAGINED` alone.
    """
    episodes = groups.episodes
    if not judge.reflector.for_world("imagined").reads_video:
        return {REAL: view(judge, groups, episodes, real=True), IMAGINED: view(judge, groups, episodes)}, None
    ahead = imagine_episodes(world_model, episodes, kinematics, shown_chunks=None, progress=AHEAD)
    imagined = imagine_episodes(world_model, episodes, kinematics, painted=ahead, progress=IMAGINED)
    return {
        REAL: view(judge, groups, episodes, real=True),
        AHEAD: view(judge, groups, ahead),
        IMAGINED: view(judge, groups, imagined),
    }, ahead


def curve(
    judge: RuledReflector,
    world_model: WorldModel,
    kinematics: ForwardKinematics,
    groups: RealGroups,
    ahead: tuple[View, Episodes],
    shown_chunks: Sequence[int],
) -> dict[int, Tensor]:
    """Correlations float64 [G] of each group when the first so many chunks are painted from real memory.

    ``ahead`` is what :func:`views` gave of one chunk ahead. Imagined is only what can be another there: groups that are
    mixed, and of them the rollouts that are not stopped within the shown chunks.
    """
    seen, painted = ahead
    out: dict[int, Tensor] = {}
    for shown in tqdm(shown_chunks, desc="real frames shown for longer", unit="length"):
        known = seen.stopped & (seen.end <= shown * world_model.chunk_length)
        rows = (groups.mixed.unsqueeze(-1) & ~known).flatten().nonzero().squeeze(-1)
        returns = seen.returns.flatten().clone()
        if len(rows):
            imagined = imagine_episodes(
                world_model, groups.episodes[rows], kinematics, shown_chunks=shown, painted=painted[rows]
            )
            scores, alive = score_episodes(judge.reflector.for_world("imagined"), imagined), imagined.alive
            stop = judge.rules["imagined"].first(scores, alive)
            returns[rows] = loop_returns(scores, stop, alive)
        out[shown] = group_correlations(groups.grouped(returns), groups.success)
    return out
