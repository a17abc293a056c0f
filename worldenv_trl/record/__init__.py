"""Rollouts and training curves as MCAP files: written while they happen, opened in any viewer, read back exactly."""

from worldenv_trl.record.logger import MCAPLogger
from worldenv_trl.record.provenance import model_hash, provenance
from worldenv_trl.record.reader import list_rollouts, read_attachments, read_metadata, read_rollouts
from worldenv_trl.record.recorder import Recorder, recorded
from worldenv_trl.record.recording import RolloutInfo
from worldenv_trl.record.repair import Repair, repair
from worldenv_trl.record.replay import replay
from worldenv_trl.record.replay_branch import parse_edit
from worldenv_trl.record.replay_report import Divergence, ReplayReport
from worldenv_trl.record.writer import RolloutWriter

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
