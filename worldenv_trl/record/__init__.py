"""Rollouts and training curves as MCAP files: written while they happen, opened in any viewer, read back exactly."""

from worldenv_trl.record.mcap import (
    MCAPLogger,
    Recorder,
    Repair,
    RolloutInfo,
    RolloutWriter,
    list_rollouts,
    model_hash,
    provenance,
    read_attachments,
    read_metadata,
    read_rollouts,
    recorded,
    repair,
)
from worldenv_trl.record.replay import Divergence, ReplayReport, parse_edit, replay

__all__ = [
    "Divergence",
    "MCAPLogger",
    "Recorder",
    "Repair",
    "ReplayReport",
    "RolloutInfo",
    "RolloutWriter",
    "list_rollouts",
    "model_hash",
    "parse_edit",
    "provenance",
    "read_attachments",
    "read_metadata",
    "read_rollouts",
    "recorded",
    "repair",
    "replay",
]
