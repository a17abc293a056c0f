"""Complete groups of rollouts behind TorchRL's collector interface."""

import warnings

import torchrl  # noqa: F401 - sets filters of its own, which must be there before ours

with warnings.catch_warnings():
    # TorchRL deprecates classes of its own in the moment in which it defines them: nobody here uses them.
    warnings.filterwarnings("ignore", message="Creating .*WeightUpdater")
    from worldenv_trl.collectors.group_collector import GroupCollector

from worldenv_trl.collectors.ray_workers import RayWorkers, check_ray
from worldenv_trl.collectors.shares import check_shares
from worldenv_trl.collectors.spread_collector import SpreadCollector
from worldenv_trl.collectors.workers import ProcessWorkers, Workers

__all__ = ["GroupCollector", "ProcessWorkers", "RayWorkers", "SpreadCollector", "Workers", "check_ray", "check_shares"]
