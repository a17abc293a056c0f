"""The sections of the page that are charts and tables of a run's figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

from worldenv_trl.metrics import rank_correlation, wilson_interval
from worldenv_trl.report.evidence import Evidence, RunRecord
from worldenv_trl.report.markup import card, interval, missing, p_text, points, rate, section, table, task_name
from worldenv_trl.report.svg import Row, Series, interval_chart, line_chart, percent
from worldenv_trl.report.verdict import alarms, evaluation

__all__ = ["drift", "honesty", "learning", "settings", "success"]

_PROTOCOLS = {
    "physics": ("The goal ends the episode", "Success: the goal holds at some step."),
    "reflector": ("The reflector ends the episode", "Success: the goal holds in the moment the reflector stops."),
}


def success(record: RunRecord) -> str:
    """Held-out success per task before and after, in both protocols."""
    parts = []
    for protocol, (title, note) in _PROTOCOLS.items():
        results = evaluation(record, protocol)
        if not results:
            continue
        rows, cells = [], []
        for task, entry in results.items():
            before, after, test = entry["before"], entry["after"], entry.get("paired", {})
            values = [(k, k, x["success"], x["low"], x["high"]) for k, x in (("before", before), ("after", after))]
            rows.append(Row(task_name(task), values, f"n = {before['episodes']}"))
            change = interval_of_points(test) if test else points(after["success"] - before["success"])
            cells.append((
                escape(task_name(task)), before["episodes"], _rated(before), _rated(after), change,
                f"{test.get('gained', math.nan):.0f} / {test.get('lost', math.nan):.0f}",
                p_text(test["p_value"]) if test else "–",
            ))  # fmt: skip
        low = min(low for row in rows for *_, low, _ in row.values)
        chart = interval_chart(rows, label=f"{title}: success before and after", x_range=(math.floor(low * 5) / 5, 1.0))
        head = ("", "episodes", "before, %", "after, %", "change, points", "won / lost", "p")
        figure = card(title, [("before", "before"), ("after", "after")], chart, kind="wide")
        parts += [figure, f'<p class="meta" style="margin:8px 0 10px">{note}</p>',
                  table(head, cells, label=title), "<div style=height:32px></div>"]  # fmt: skip
    if not parts:
        parts = [missing("Missing: the stage evaluate has not finished, so there is no success before and after.")]
    say = (
        "Greedy policies on initial states that nobody has learned from; both on the same ones. Bars are 95 % Wilson "
        "intervals, changes are tested in pairs (exact McNemar)."
    )
    return section("success", "Success, before and after", say, *parts)


def learning(record: RunRecord) -> str:
    """Success per LOOP iteration, and the losses of every stage."""
    parts = [_loop_card(record, stage) for stage in record.stages("post_train")]
    parts = [part for part in parts if part]
    say = (
        "Real success (the probe, on training contexts, never learned from) should rise with the imagined one. "
        "Bands are 95 % intervals."
    )
    if not parts:
        parts = [
            missing("Missing: the stage post_train has logged no iteration, not yet or because all tasks are held.")
        ]
    losses = [
        card(f"{stage}: {name}", [], line_chart(
            [Series(name, "plain", *record.series(stage, key))], label=f"{stage}, {name}", x_label="step", y_label="",
            width=340, height=210,
        ))
        for stage in record.stages("")
        for key, name in (
            ("l1", "L1 of the action chunk"), ("nll", "Laplace NLL of the scale head"),
            ("cross_entropy", "cross-entropy of the action tokens"), ("loss", "loss"), ("encoder_loss", "encoder loss"),
            ("kl_approx", "KL per step"), ("clip_fraction", "clipped ratios"),
        )
        if len(record.series(stage, key)[0]) > 1
    ]  # fmt: skip
    if losses:
        parts += ["<h3>Losses and steps</h3>", f'<div class="figures small">{"".join(losses)}</div>']
    return section("learning", "Learning", say, *parts)


def _loop_card(record: RunRecord, stage: str) -> str:
    lines = [x for x in record.lines if x["stage"] == stage and "step" in x]
    if not lines:
        return ""
    settings = record.config.get("post_train", {})
    tasks = len(record.config.get("tasks", []) or [1])
    count = next(
        (x["probe_episodes"] for x in lines if "probe_episodes" in x), settings.get("probe_contexts", 0) * tasks
    )
    rollouts = settings.get("groups", 0) * settings.get("group_size", 0)
    series, legend, details = [], [], []
    for key, name, colour, n in (
        ("return", "imagined return, sampled", "plain", 0),
        ("imagined_success", "imagined success, greedy", "imagined", count),
        ("real_success", "real success, greedy", "real", count),
    ):
        x, y = record.series(stage, key)
        if not x:
            continue
        bounds = [wilson_interval(round(value * n), n) if n else (math.nan, math.nan) for value in y]
        low, high = [a for a, _ in bounds], [b for _, b in bounds]
        series.append(Series(name, colour, x, y, low if n else (), high if n else (), dots=bool(n)))
        legend.append((f"{name}, n = {n or rollouts}", colour))
        details += [(f"{step:g}", name, rate(value)) for step, value in zip(x, y, strict=True) if n]
    if not series:
        return ""
    marks = [(line["step"], "alarm") for line in alarms(record) if line["stage"] == stage][:1]
    floor = min(v for line in series for v in (*line.y, *line.low))
    chart = line_chart(
        series, label=f"{stage}: success per iteration", x_label="LOOP iteration", y_label="",
        y_range=(min(0.8, math.floor(floor * 5) / 5), 1),
        fmt=percent, marks=marks, width=1000, height=340,
    )  # fmt: skip
    cost = [(x["probe_seconds"], x["step"]) for x in lines if "probe_seconds" in x]
    spent = sum(x.get("iteration_seconds", 0) for x in lines)
    words = f"{stage}, {len(lines)} iterations"
    if cost and spent:
        words += f"; the probe took {100 * sum(s for s, _ in cost) / spent:.1f} % of the iterations’ time"
    return card(words, legend, chart, table(("iteration", "", "%"), details), kind="wide")


def honesty(record: RunRecord, evidence: Evidence | None) -> str:
    """The imagined-versus-real tables."""
    parts = []
    if evidence and evidence.honesty:
        parts += [
            "<h3>Held-out contexts: the policy’s actions from the physics, imagined</h3>",
            _honesty_table("policy", evidence.honesty),
        ]
    if evidence and evidence.waves:
        parts += [
            "<h3>What LOOP learned from: its imagined rollouts, executed in the physics</h3>",
            '<p class="say">The harder test: these actions were rewarded in imagination. A gap that grows from the '
            "first to the last iteration is a policy that learns the world model’s errors. Signal is the correlation "
            "of imagined return and real success among the rollouts of one context, which is all that an advantage "
            "sees (mean over the contexts with both outcomes, their number in brackets).</p>",
            _honesty_table("iteration", evidence.waves),
        ]
    for stage in record.stages("post_train"):
        pairs = [
            (x["imagined_success"], x["real_success"])
            for x in record.lines
            if x["stage"] == stage and "imagined_success" in x and "real_success" in x
        ]
        if len(pairs) > 2:
            rho = rank_correlation(*zip(*pairs, strict=True))
            if math.isfinite(rho):
                parts.append(
                    f'<p class="say" style="margin-top:20px">Rank correlation of imagined and real success over the '
                    f"<strong>{len(pairs)} policies</strong> probed in {escape(stage)}: <strong>{rho:.2f}</strong> "
                    "(1: imagination orders them as the physics does).</p>"
                )
        parts += _probed_tasks(record, stage)
    if not (evidence and evidence.honesty):
        parts.insert(0, missing(_absent(evidence, "no imagined-versus-real table of the policies")))
    say = (
        "The same initial states and the same actions in imagination and in the physics. A stop counts as right if the "
        "physics reaches the goal by then or two steps later; stop error is the mean absolute difference in steps "
        "(signed mean in brackets, positive: imagination is late). Gaps are imagined minus real, with 95 % intervals."
    )
    return section("honesty", "Imagined versus real", say, *parts)


def drift(evidence: Evidence | None) -> str:
    """PSNR against the horizon."""
    say = (
        "Open-loop imagination under the policy’s own actions on held-out contexts, against the frames of the physics."
    )
    if not evidence or not evidence.drift:
        return section("drift", "Drift", say, missing(_absent(evidence, "no drift curves")))
    parts = []
    for key, title in (("psnr", "All pixels"), ("moving_psnr", "Moving pixels")):
        series, legend = [], []
        for index, (policy, figures) in enumerate(evidence.drift.items()):
            colour = "before" if index == 0 and len(evidence.drift) > 1 else "imagined"
            x = figures["horizon"].tolist()
            low, high = (figures[f"{key}_{end}"].tolist() for end in ("low", "high"))
            series.append(Series(f"imagined, {policy}", colour, x, figures[key].tolist(), low, high))
            legend.append((f"imagined, {policy}", colour))
        series.append(Series("copy of the first frame", "plain", x, figures[f"copy_{key}"].tolist(), dashed=True))
        legend.append(("copy of the first frame", "dashed"))
        wanted = [k for k in (1, 10, 20, 30, 40, 50, 60) if k <= len(x)]
        details = table(
            ("step", *(line.name for line in series)),
            [(k, *(f"{line.y[k - 1]:.1f}" for line in series)) for k in wanted],
        )
        chart = line_chart(series, label=f"PSNR of {title.lower()} against the horizon", x_label="env step (horizon)",
                           y_label="PSNR, dB", fmt=lambda v: f"{v:.1f}", height=300)  # fmt: skip
        parts.append(card(title, legend, chart, details))
    note = f"{evidence.episodes} episodes a policy; bands are 95 % intervals of the mean."
    return section("drift", "Drift", f"{say} {note}", f'<div class="figures">{"".join(parts)}</div>')


def settings(record: RunRecord, evidence: Evidence | None) -> str:
    """Stages, versions and the config."""
    import yaml

    order = list(dict.fromkeys(line["stage"] for line in record.lines))
    total = sum(record.seconds.values()) or 1
    stages = [
        (escape(name), f"{record.seconds[name]:.0f} s", f"{100 * record.seconds[name] / total:.0f} %")
        if name in record.seconds
        else (f"{escape(name)} <small>(unfinished)</small>", "–", "–")
        for name in order
    ]
    parts = [
        '<div class="two"><div><h3>Stages</h3>',
        table(("stage", "time", "share"), stages) if stages else missing("No stage has run yet."),
        "</div><div><h3>Versions</h3>",
        _versions(record),
        "</div></div>",
        _begun(record),
        "<h3>Config</h3>",
        f'<pre tabindex="0">{escape(yaml.safe_dump(record.config, sort_keys=False))}</pre>',
    ]
    if evidence and evidence.notes:
        notes = "".join(f"<li>{escape(note)}</li>" for note in evidence.notes)
        parts.append(f"<h3>How this was measured</h3><ul>{notes}</ul>")
    return section("config", "Config and versions", "What was run, and for how long.", *parts)


def _begun(record: RunRecord) -> str:
    """Of whose stages it began with."""
    names = ", ".join(escape(str(name)) for name in record.begun.get("stages", ()))
    return f"<p>Taken over from {escape(str(record.begun.get('run')))}: {names}.</p>" if names else ""


def _versions(record: RunRecord) -> str:
    """Of the run, of what continued it, and of this report where they differ."""
    known = list(record.run_versions)
    heads = ["the run", *["continued with"] * (len(known) - 1)] if known else []
    if record.versions not in known:
        known, heads = [*known, record.versions], [*heads, "this report"]
    names = list(dict.fromkeys(name for each in known for name in each))
    rows = [(escape(name), *(escape(str(each.get(name, "–"))) for each in known)) for name in names]
    note = "" if record.run_versions else missing("Missing: the run did not note its versions.")
    return table(("package", *heads), rows) + note


def _absent(evidence: Evidence | None, what: str) -> str:
    reasons = "; ".join(evidence.missing) if evidence else "the models were not asked (--no-models)"
    return f"Missing: {what}. {reasons[:1].upper()}{reasons[1:]}."


def interval_of_points(test: dict[str, Any]) -> str:
    return f"{points(test['difference'])} <small>[{points(test['low'])}, {points(test['high'])}]</small>"


def _rated(line: dict[str, Any]) -> str:
    return interval(line["success"], line["low"], line["high"])


def _probed_tasks(record: RunRecord, stage: str) -> list[str]:
    """The first and the last probe of LOOP, task by task; nothing of a run that did not note them."""
    cells, worlds = [], ("imagined_success", "real_success")
    for task in record.config.get("tasks", []):
        found = [record.series(stage, f"{world}_{task}")[1] for world in worlds]
        if all(found):
            gap = found[0][-1] - found[1][-1]
            cells.append((escape(task_name(task)), *(rate(each[at]) for at in (0, -1) for each in found), points(gap)))
    if not cells:
        return []
    figures = [f"{world}, {when}, %" for when in ("first", "last") for world in ("imagined", "real")]
    shown = table(("task", *figures, "last gap, points"), cells, label=f"probes of {stage}")
    return [f"<h3>The probes of {escape(stage)}, task by task</h3>", shown]


def _honesty_table(first: str, rows: Sequence[dict[str, Any]]) -> str:
    """Figures of :func:`~worldenv_trl.metrics.honesty` by ``first`` and task."""
    figures = ["imagined, %", "real, %", "gap, points", "precision", "recall", "F1", "stop error"]
    figures += ["signal"] if rows and "signal" in rows[0] else []
    cells = [
        (escape(str(row[first])), escape(task_name(row["task"])), *_honest_cells(row), _steps(row), *_signal(row))
        for row in rows
    ]
    return table((first, "task", "n", *figures), cells, words=2)


def _signal(row: dict[str, Any]) -> list[str]:
    if "signal" not in row:
        return []
    return [f"{row['signal']:.2f} <small>({row['mixed']})</small>".replace("-", "−") if row["mixed"] else "–"]


def _honest_cells(row: dict[str, Any]) -> tuple[Any, ...]:
    gap = f"{points(row['gap'])} <small>[{points(row['gap_low'])}, {points(row['gap_high'])}]</small>"
    defined = {"precision": row["imagined"], "recall": row["real"], "f1": row["imagined"] or row["real"]}
    figures = (f"{row[name]:.2f}" if some else "–" for name, some in defined.items())
    return row["n"], rate(row["imagined"]), rate(row["real"]), gap, *figures


def _steps(row: dict[str, Any]) -> str:
    if not math.isfinite(row.get("stop_error", math.nan)):
        return "–"
    return f"{row['stop_error']:.1f} <small>({row['stop_bias']:+.1f})</small>".replace("(-", "(−")
