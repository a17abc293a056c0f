"""Reward models that judge from video when a task is done."""

from worldenv_trl.reflectors.base import Reflector, prefix_indices
from worldenv_trl.reflectors.compact import CompactReflector, CompactReflectorConfig, blurred

__all__ = ["CompactReflector", "CompactReflectorConfig", "Reflector", "blurred", "prefix_indices"]
