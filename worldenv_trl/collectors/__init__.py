"""Complete groups of rollouts behind TorchRL's collector interface."""

import warnings

import torchrl  # noqa: F401 - sets filters of its own, which must be there before ours

with warnings.catch_warnings():
    # TorchRL deprecates classes of its own in the moment in which it defines them: nobody here uses them.
    warnings.filterwarnings("ignore", message="Creating .*WeightUpdater")
    from worldenv_trl.collectors.group_collector import GroupCollector

__all__ = ["GroupCollector"]
