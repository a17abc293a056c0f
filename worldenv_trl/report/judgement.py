"""The section about the reflector: is 0.8 four times in five, and what does it confuse?"""

from __future__ import annotations

import math
from html import escape
from typing import Any

from torch import Tensor

from worldenv_trl.metrics import classification, wilson_interval
from worldenv_trl.report.evidence import Evidence, RunRecord
from worldenv_trl.report.markup import card, missing, section, table, task_name
from worldenv_trl.report.svg import Series, line_chart

__all__ = ["calibration", "reflector"]

_NAMES = {"real": "real frames", "imagined": "imagined frames"}


def calibration(probability: Tensor, label: Tensor, bins: int = 10) -> list[dict[str, float]]:
    """Reliability of probabilities ``[n]`` against bool ``[n]``: for each bin that holds any, ``mean`` probability,
    ``rate`` of True with a Wilson interval ``low``, ``high``, and ``n``."""
    place = (probability * bins).long().clamp(0, bins - 1)
    out = []
    for index in range(bins):
        inside = place == index
        n = int(inside.sum())
        if n:
            hits = int(label[inside].sum())
            low, high = wilson_interval(hits, n)
            mean = probability[inside].double().mean().item()
            out.append({"mean": mean, "rate": hits / n, "low": low, "high": high, "n": n})
    return out


def reflector(record: RunRecord, evidence: Evidence | None) -> str:
    """Calibration, confusion, and the held-out figures of its training."""
    parts = []
    if evidence and evidence.scores:
        parts.append(f'<div class="figures">{_calibration_card(evidence)}{_confusions(evidence)}</div>')
    else:
        reasons = "; ".join(evidence.missing) if evidence else "the models were not asked (--no-models)"
        parts.append(missing(f"Missing: calibration and confusion. {reasons}."))
    lines = [x for x in record.lines if "stop_precision" in x]
    if lines:
        head = ("frames", "task", "episodes", "frame F1", "precision", "recall", "AUC", "stop precision", "stop recall")
        rows = [
            (_NAMES.get(x["rollouts"], x["rollouts"]), escape(task_name(x["task"])), x["episodes"],
             *(_two(x[key]) for key in ("frame_f1", "frame_precision", "frame_recall", "frame_auc")),
             _two(x["stop_precision"]), _two(x["stop_recall"]))
            for x in lines
        ]  # fmt: skip
        early = "<p>A stop before the physics reaches the goal is wrong, be it by a single real frame.</p>"
        parts += ["<h3>On held-out exploration, when it was trained</h3>", table(head, rows, words=2), early]
    say = (
        "R is the probability that the task is done, given the frames so far. On the diagonal it means what it says; "
        "above it is too careful, below it too sure. Frames of one episode resemble each other: "
        "the true intervals are wider."
    )
    return section("reflector", "Reflector", say, *parts)


def _calibration_card(evidence: Evidence) -> str:
    series, rows = [], []
    for name, (probability, label) in evidence.scores.items():
        found = calibration(probability, label)
        mean, rate, low, high = ([entry[key] for entry in found] for key in ("mean", "rate", "low", "high"))
        series.append(Series(_NAMES[name], name, mean, rate, low, high, dots=True))
        rows += [
            (
                _NAMES[name],
                f"{e['mean']:.2f}",
                f"{e['rate']:.2f} <small>[{e['low']:.2f}, {e['high']:.2f}]</small>",
                e["n"],
            )
            for e in found
        ]
    chart = line_chart(
        series, label="Calibration of the reflector", x_label="R, mean of the bin", y_label="frames with the goal",
        x_range=(0, 1), y_range=(0, 1), diagonal=True, height=340, fmt=lambda v: f"{v:.2g}",
    )  # fmt: skip
    legend = [(_NAMES[name], name) for name in evidence.scores]
    return card("Calibration", legend, chart, table(("frames", "R", "goal holds", "n"), rows))


def _confusions(evidence: Evidence) -> str:
    blocks = []
    for name, (probability, label) in evidence.scores.items():
        threshold, consecutive = evidence.rules[name]
        said = probability > threshold
        counts = {(t, p): int(((label == t) & (said == p)).sum()) for t in (True, False) for p in (True, False)}
        figures = classification(probability, label, threshold)
        rows = "".join(
            f'<tr><th scope="row">{"goal holds" if truth else "not yet"}</th>'
            + "".join(_cell(counts, truth, guess) for guess in (True, False))
            + "</tr>"
            for truth in (True, False)
        )
        frames = "frame" if consecutive == 1 else "frames in a row"
        blocks.append(
            f'<h4 style="margin-top:14px">{_NAMES[name]} <span class="meta">F1 {_two(figures.f1)} · '
            f"AUC {_two(figures.auc)} · stops after {consecutive} {frames} above {threshold:g}</span></h4>"
            f'<table class="confusion"><thead><tr><th></th><th scope="col">R says done</th>'
            f'<th scope="col">R says not yet</th></tr></thead><tbody>{rows}</tbody></table>'
        )
    return f'<figure class="card"><figcaption>Confusion, frame by frame</figcaption>{"".join(blocks)}</figure>'


def _cell(counts: dict[tuple[bool, bool], int], truth: bool, guess: bool) -> str:
    share = counts[truth, guess] / max(1, counts[truth, True] + counts[truth, False])
    kind = "right" if truth == guess else "wrong"
    return (
        f'<td><span class="cell {kind}" style="--share:{share:.3f}">{100 * share:.1f} %'
        f"<small>{counts[truth, guess]:,} frames</small></span></td>"
    )


def _two(value: Any) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.2f}"
