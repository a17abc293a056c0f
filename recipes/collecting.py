"""Where rollouts are collected: in this process, in others of this machine, or on a Ray cluster (``--collectors``)."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass

import torch

from config import WorldEnvConfig
from threads import OF_A_WORKER
from worldenv_trl.collectors import ProcessWorkers, RayWorkers, Workers, check_ray, check_shares


@dataclass(frozen=True)
class Spread:
    """Workers, and the shares of a wave; by default as many as :class:`SpreadCollector` makes of it."""

    backend: str
    workers: int
    shares: int | None = None


def spread_of(collectors: str) -> Spread | None:
    """What ``process:2``, ``ray:4`` or ``ray:4/12`` (workers/shares) names; None for ``local``.

    Raises:
        ValueError: for anything else.

    Examples:
        >>> spread_of("ray:4/12")
        Spread(backend='ray', workers=4, shares=12)
    """
    if collectors == "local":
        return None
    match = re.fullmatch(r"(process|ray):([0-9]+)(?:/([0-9]+))?", collectors)
    if match is None:
        raise ValueError(f"collectors must be local, process:WORKERS or ray:WORKERS, got {collectors!r}")
    workers, shares = int(match[2]), None if match[3] is None else int(match[3])
    if workers < 1:
        raise ValueError(f"collectors must name at least 1 worker, got {collectors!r}: use local for none")
    if shares is not None and shares < workers:
        raise ValueError(f"collectors must name as many shares as workers, {workers}, or more, got {collectors!r}")
    return Spread(match[1], workers, shares)


def check_collectors(config: WorldEnvConfig) -> None:
    """Fails before any long work starts if there are more workers than groups, or no Ray.

    Raises:
        ValueError: naming the setting.
        RuntimeError: if no Ray cluster answers.
    """
    spread = spread_of(config.collectors)
    if spread is None:
        return
    physical, tasks = config.post_train.env == "tabletop", len(config.tasks)
    waves = [
        ("post_train.groups", config.post_train.groups, tasks if physical else 1),
        ("evaluate.num_envs", rows_of_waves(config.evaluate.episodes_per_task, config.evaluate.num_envs), 1),
    ]
    if not physical:
        waves.append(("explore.num_envs", config.explore.num_envs, tasks))
    for name, groups, deal in waves:
        check_shares(groups, spread.workers, deal, name)
    if spread.backend == "ray":
        check_ray()


def rows_of_waves(episodes: int, most: int) -> int:
    """Rows of the fewest waves alike of at most ``most`` rows: a last wave is not made of episodes that have been.

    Examples:
        >>> rows_of_waves(60, 50)
        30
    """
    return -(-episodes // -(-episodes // most))


def start_workers(spread: Spread, device: torch.device) -> Workers:
    """With models on a GPU, those of Ray share the cluster's.

    Raises:
        RuntimeError: if a Ray cluster has no room for them.
    """
    if spread.backend == "process":
        return ProcessWorkers(spread.workers)
    return RayWorkers(spread.workers, gpu=device.type == "cuda")


def of_worker(config: WorldEnvConfig) -> WorldEnvConfig:
    """Settings of an env of a worker."""
    return dataclasses.replace(config, num_threads=OF_A_WORKER)
