"""Recordings for the eye: what a viewer shows of them, in Foxglove and in Rerun."""

from worldenv_trl.record.view.foxglove import foxglove_layout, foxglove_paths
from worldenv_trl.record.view.rerun import require_rerun, rerun_blueprint, rerun_recording
from worldenv_trl.record.view.shown import Curve, Shown, shown_rollouts

__all__ = [
    "Curve",
    "Shown",
    "foxglove_layout",
    "foxglove_paths",
    "require_rerun",
    "rerun_blueprint",
    "rerun_recording",
    "shown_rollouts",
]
