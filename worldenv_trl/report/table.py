"""The final table of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

PROTOCOLS = ("physics", "reflector")


def read_metrics(run_dir: str | Path) -> list[dict[str, Any]]:
    """The lines of ``metrics.jsonl``; one that a crash cut short, or that is of no stage, is left out.

    Raises:
        FileNotFoundError: if the folder holds no ``metrics.jsonl``.
    """
    path = Path(run_dir) / "metrics.jsonl"
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: {run_dir} is not a run folder, or nothing has run in it yet")
    lines = []
    for text in path.read_text().splitlines():
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            continue
    return [line for line in lines if isinstance(line, dict) and "stage" in line]


def summary_table(run_dir: str | Path) -> str:
    """Held-out success before and after, per task and protocol, with 95 % intervals and the paired p-value."""
    lines = [line for line in read_metrics(run_dir) if line["stage"] == "evaluate"]
    rows = [("protocol", "task", "before", "after", "change", "p (paired)")]
    for protocol in PROTOCOLS:
        measured = [line for line in lines if line.get("protocol") == protocol]
        policies = list(dict.fromkeys(line["policy"] for line in measured if "policy" in line))
        if len(policies) != 2:
            continue
        for task in dict.fromkeys(line["task"] for line in measured if "policy" in line):
            before, after = (
                next(line for line in measured if line.get("policy") == name and line["task"] == task)
                for name in policies
            )
            test = next((line for line in measured if line.get("paired") and line["task"] == task), {})
            change = 100 * (after["success"] - before["success"])
            rows.append((protocol, task, _interval(before), _interval(after), f"{change:+.1f}", _p_value(test)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    text.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(text)


def _interval(line: dict[str, Any]) -> str:
    return f"{100 * line['success']:.1f} [{100 * line['low']:.1f}, {100 * line['high']:.1f}] n={line['episodes']}"


def _p_value(test: dict[str, Any]) -> str:
    return f"{test['p_value']:.2g}" if "p_value" in test else "-"
