"""Recorded rollouts once more: in the physics or in a world model, the same or with something changed."""

from worldenv_trl.record.replay.branch import parse_edit
from worldenv_trl.record.replay.play import replay
from worldenv_trl.record.replay.report import Divergence, ReplayReport

__all__ = ["Divergence", "ReplayReport", "parse_edit", "replay"]
