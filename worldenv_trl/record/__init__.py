"""Rollouts and training curves as MCAP files: written while they happen, opened in any viewer, read back exactly."""

from worldenv_trl.record.logger import MCAPLogger
from worldenv_trl.record.reader import read_attachments, read_metadata, read_rollouts
from worldenv_trl.record.writer import RolloutWriter

__all__ = ["MCAPLogger", "RolloutWriter", "read_attachments", "read_metadata", "read_rollouts"]
