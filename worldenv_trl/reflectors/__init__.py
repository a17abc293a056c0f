"""Reward models that judge from video when a task is done."""

from worldenv_trl.reflectors.base import Lesson, Reflector
from worldenv_trl.reflectors.compact import CompactReflector, CompactReflectorConfig
from worldenv_trl.reflectors.compact_lessons import CompactLessons
from worldenv_trl.reflectors.dual import DualReflector, DualReflectorConfig
from worldenv_trl.reflectors.path import PathReflector, PathReflectorConfig
from worldenv_trl.reflectors.path_lessons import PathLessons
from worldenv_trl.reflectors.stop_rule import StopRule
from worldenv_trl.reflectors.vlm import PromptReflector, PromptReflectorConfig, VLMReflector, VLMReflectorConfig
from worldenv_trl.reflectors.vlm_lessons import VLMLessons

__all__ = [
    "CompactLessons",
    "CompactReflector",
    "CompactReflectorConfig",
    "DualReflector",
    "DualReflectorConfig",
    "Lesson",
    "PathLessons",
    "PathReflector",
    "PathReflectorConfig",
    "PromptReflector",
    "PromptReflectorConfig",
    "Reflector",
    "StopRule",
    "VLMLessons",
    "VLMReflector",
    "VLMReflectorConfig",
]
