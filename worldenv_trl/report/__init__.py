"""Plots and tables of a run folder."""

from worldenv_trl.report.plots import plot_run
from worldenv_trl.report.table import summary_table

__all__ = ["plot_run", "summary_table"]
