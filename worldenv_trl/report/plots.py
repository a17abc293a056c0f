"""Figures of a run folder, written to ``plots/``."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from worldenv_trl.report.table import PROTOCOLS, read_metrics


def plot_run(run_dir: str | Path) -> list[Path]:
    """Draws training losses, imagined next to real success per LOOP iteration, and success before and after.

    Returns the files written; figures for which nothing was measured are left out.

    Raises:
        FileNotFoundError: if the folder holds no ``metrics.jsonl``.
    """
    import matplotlib

    matplotlib.use("Agg")
    lines = read_metrics(run_dir)
    folder = Path(run_dir) / "plots"
    folder.mkdir(exist_ok=True)
    figures = {
        "losses": _losses(lines),
        "imagined_and_real_success": _success_per_iteration(lines),
        "evaluation": _evaluation(lines),
    }
    written = []
    for name, figure in figures.items():
        if figure is not None:
            path = folder / f"{name}.png"
            figure.savefig(path, dpi=120, bbox_inches="tight")
            written.append(path)
    return written


def _series(lines: list[dict[str, Any]], stage: str, key: str) -> tuple[list[float], list[float]]:
    points = [(line["step"], line[key]) for line in lines if line["stage"] == stage and "step" in line and key in line]
    return [x for x, _ in points], [y for _, y in points]


def _losses(lines: list[dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    wanted = [
        (stage, key)
        for stage in dict.fromkeys(line["stage"] for line in lines)
        for key in ("l1", "nll", "cross_entropy", "loss", "encoder_loss")
    ]
    found = [(stage, key, *_series(lines, stage, key)) for stage, key in wanted]
    found = [item for item in found if item[2]]
    if not found:
        return None
    figure = Figure(figsize=(3.2 * len(found), 2.6))
    for number, (stage, key, x, y) in enumerate(found, start=1):
        axes = figure.add_subplot(1, len(found), number)
        axes.plot(x, y)
        axes.set(title=f"{stage}: {key}", xlabel="step")
    figure.tight_layout()
    return figure


def _success_per_iteration(lines: list[dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    learned = (line["stage"] for line in lines if "return" in line)
    stages = [stage for stage in dict.fromkeys(learned) if stage.startswith("post_train")]
    if not stages:
        return None
    figure = Figure(figsize=(6.4 * len(stages), 3.2))
    for number, stage in enumerate(stages, start=1):
        axes = figure.add_subplot(1, len(stages), number)
        for key, label in (
            ("return", "imagined return, sampled"),
            ("imagined_success", "imagined success, greedy"),
            ("real_success", "real success, greedy, training contexts"),
        ):
            x, y = _series(lines, stage, key)
            if x:
                axes.plot(x, y, marker=".", label=label)
        axes.set(title=stage, xlabel="LOOP iteration", ylim=(0, 1))
        axes.legend(fontsize=7)
    return figure


def _evaluation(lines: list[dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    lines = [line for line in lines if line["stage"] == "evaluate" and "policy" in line]
    if not lines:
        return None
    figure = Figure(figsize=(10, 3.2))
    for number, protocol in enumerate(PROTOCOLS, start=1):
        axes = figure.add_subplot(1, 2, number)
        measured = [line for line in lines if line["protocol"] == protocol]
        tasks = list(dict.fromkeys(line["task"] for line in measured))
        for offset, policy in enumerate(dict.fromkeys(line["policy"] for line in measured)):
            rows = [line for line in measured if line["policy"] == policy]
            heights = [row["success"] for row in rows]
            spans = [  # in older metrics a bound may lie a rounding on the wrong side
                [max(0.0, h - row["low"]) for h, row in zip(heights, rows, strict=True)],
                [max(0.0, row["high"] - h) for h, row in zip(heights, rows, strict=True)],
            ]
            axes.bar([i + 0.4 * offset for i in range(len(rows))], heights, 0.38, yerr=spans, capsize=3, label=policy)
        axes.set_xticks(
            [i + 0.2 for i in range(len(tasks))],
            [textwrap.fill(task.split("/")[-1].replace("_", " "), 14) for task in tasks],
            fontsize=7,
        )
        axes.set(title=f"held-out success, {protocol} stops", ylim=(0, 1))
        axes.legend(fontsize=7)
    return figure
