"""Plots, tables and the HTML report of a run folder."""

from worldenv_trl.report.evidence import Clip, Evidence, RunRecord, choose_clips, count_kinds, machine_versions
from worldenv_trl.report.page import render_report, write_report
from worldenv_trl.report.plots import plot_run
from worldenv_trl.report.table import read_metrics, summary_table
from worldenv_trl.report.video import video_webm

__all__ = [
    "Clip",
    "Evidence",
    "RunRecord",
    "choose_clips",
    "count_kinds",
    "machine_versions",
    "plot_run",
    "read_metrics",
    "render_report",
    "summary_table",
    "video_webm",
    "write_report",
]
