"""Rollouts for LOOP: complete groups behind TorchRL's collector interface."""

from worldenv_trl.collectors.group_collector import GroupCollector

__all__ = ["GroupCollector"]
