"""MCAP files of rollouts and training curves: written while they happen, read back exactly, repaired."""

from worldenv_trl.record.mcap.logger import MCAPLogger
from worldenv_trl.record.mcap.provenance import model_hash, provenance
from worldenv_trl.record.mcap.reader import list_rollouts, read_attachments, read_metadata, read_rollouts
from worldenv_trl.record.mcap.recorder import Recorder, recorded
from worldenv_trl.record.mcap.recording import RolloutInfo
from worldenv_trl.record.mcap.repair import Repair, repair
from worldenv_trl.record.mcap.writer import RolloutWriter

__all__ = [
    "MCAPLogger",
    "Recorder",
    "Repair",
    "RolloutInfo",
    "RolloutWriter",
    "list_rollouts",
    "model_hash",
    "provenance",
    "read_attachments",
    "read_metadata",
    "read_rollouts",
    "recorded",
    "repair",
]
