"""The top of the page: what changed, how sure that is, and what to look at first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

from worldenv_trl.report.evidence import Clip, Evidence, RunRecord
from worldenv_trl.report.markup import p_text, points, rate, task_name

__all__ = ["alarms", "evaluation", "headline"]


def evaluation(record: RunRecord, protocol: str) -> dict[str, dict[str, Any]]:
    """By task: ``before`` and ``after`` (metric lines) and, where tested, ``paired``; empty if not evaluated."""
    lines = [x for x in record.lines if x["stage"] == "evaluate" and x.get("protocol") == protocol]
    policies = list(dict.fromkeys(x["policy"] for x in lines if "policy" in x))
    if len(policies) != 2:
        return {}
    found: dict[str, dict[str, Any]] = {}
    for name, policy in zip(("before", "after"), policies, strict=True):
        for line in lines:
            if line.get("policy") == policy:
                found.setdefault(line["task"], {})[name] = line
    for line in lines:
        if line.get("paired") and line["task"] in found:
            found[line["task"]]["paired"] = line
    return {task: entry for task, entry in found.items() if {"before", "after"} <= set(entry)}


def _probes(record: RunRecord) -> list[dict[str, Any]]:
    """Those of post-training that the honesty alarm has seen."""
    return [x for x in record.lines if x["stage"].startswith("post_train") and "honesty_alarm" in x]


def alarms(record: RunRecord) -> list[dict[str, Any]]:
    """The probes of post-training at which the honesty alarm fired."""
    return [x for x in _probes(record) if x["honesty_alarm"]]


def headline(record: RunRecord, evidence: Evidence | None) -> str:
    """Title, sentence and tiles."""
    results = evaluation(record, "physics")
    title, lede = _verdict(results)
    tiles = [*_success_tiles(results), *_model_tiles(record, evidence)]
    total = sum(record.seconds.values())
    if total:
        count = len(record.seconds)
        tiles.append(("Time of the whole run", _duration(total), f"{count} finished stage{'s' * (count != 1)}"))
    boxes = "".join(
        f"<div class=tile><dt>{escape(name)}</dt><dd>{value}<small>{note}</small></dd></div>"
        for name, value, note in tiles
    )
    config = record.config
    tasks = len(config.get("tasks", []))
    eyebrow = " · ".join(
        (record.path.resolve().name, f"seed {config.get('seed', '?')}", f"{tasks} task{'s' * (tasks != 1)}")
    )
    first = _look_first(results, evidence)
    hints = (
        f'<div class="notice" style="margin-top:28px"><strong>Look at first</strong><ul>{first}</ul></div>'
        if first
        else ""
    )
    warning = _alarm_notice(record)
    return (
        f'<header class="top"><p class="eyebrow">{escape(eyebrow)}</p><h1>{title}</h1><p class="lede">{lede}</p>'
        f'<dl class="tiles">{boxes}</dl>{warning}{hints}</header>'
    )


def _verdict(results: dict[str, dict[str, Any]]) -> tuple[str, str]:
    if "all" not in results or "paired" not in results["all"]:
        return "Not evaluated yet", "The run holds no success before and after on the same initial states."
    before, after, test = (results["all"][name] for name in ("before", "after", "paired"))
    low, high, p = test["low"], test["high"], test["p_value"]
    change = f"{abs(100 * test['difference']):.1f} points"
    sure = p < 0.05
    if sure and test["difference"] > 0:
        title = f'Post-training gains <span class="good">{change}</span> of held-out success'
    elif sure:
        title = f'Post-training <span class="bad">costs {change}</span> of held-out success'
    else:
        title = "Held-out success has not changed measurably"
    lede = (
        f"<strong>{rate(before['success'])} % → {rate(after['success'])} %</strong> greedy success in the physics on "
        f"the same {before['episodes']} initial states. Change {points(test['difference'])} points, 95 % interval "
        f"[{points(low)}, {points(high)}], exact McNemar p = {p_text(p)}: {test['gained']:.0f} episodes won, "
        f"{test['lost']:.0f} lost."
    )
    return title, lede


def _success_tiles(results: dict[str, dict[str, Any]]) -> list[tuple[str, str, str]]:
    tiles = []
    tasks = [task for task in results if task != "all"]
    if tasks:
        weakest = min(tasks, key=lambda task: results[task]["after"]["success"])
        entry = results[weakest]["after"]
        note = f"{escape(task_name(weakest))} [{rate(entry['low'])}, {rate(entry['high'])}]"
        tiles.append(("Weakest task after", f"{rate(entry['success'])} %", note))
    return tiles


def _model_tiles(record: RunRecord, evidence: Evidence | None) -> list[tuple[str, str, str]]:
    tiles = []
    rows = [row for row in (evidence.honesty if evidence else ()) if row["task"] == "all"]
    if rows:
        row = rows[-1]
        found = f"{rate(row['recall'])} % of the real ones are found" if row["real"] else "none is real"
        note = f"of the stops on {row['n']} held-out episodes; {found}"
        value = f"{rate(row['precision'])} %" if row["imagined"] else "–"
        tiles.append(("Imagined successes that are real", value, note))
    probes, fired = _probes(record), alarms(record)
    if fired:
        tiles.append(("Honesty alarm", '<span class="bad">fired</span>', f"at iteration {fired[0]['step']}"))
    elif len(probes) == 1:
        tiles.append(("Honesty alarm", "silent", "one probe, and nothing to compare it with"))
    elif probes:
        imagined, real = (points(probes[-1][f"{world}_rise"]) for world in ("imagined", "real"))
        note = f"since the first probes imagined success has changed by {imagined} points, real success by {real}"
        tiles.append(("Honesty alarm", '<span class="good">silent</span>', note))
    if evidence and evidence.drift:
        drift = list(evidence.drift.values())[-1]
        psnr = float(drift["moving_psnr"][-1])
        if math.isfinite(psnr):
            copied = float(drift["copy_moving_psnr"][-1])
            note = f"PSNR at step {int(drift['horizon'][-1])}; copying the first frame: {copied:.1f}"
            tiles.append(("Moving pixels, imagined", f"{psnr:.1f} dB", note))
    return tiles


def _look_first(results: dict[str, dict[str, Any]], evidence: Evidence | None) -> str:
    """At most three hints, each with its figures and a link."""
    hints: list[str] = []
    lost = [
        (entry["paired"]["difference"], task) for task, entry in results.items() if task != "all" and "paired" in entry
    ]
    if lost and min(lost)[0] < 0 and results[min(lost)[1]]["paired"]["p_value"] < 0.05:
        change, task = min(lost)
        hints.append(f'<a href="#success">{escape(task_name(task))}</a> got worse by {abs(100 * change):.1f} points.')
    if evidence:
        hints += _clip_hints(evidence.clips, evidence)
    return "".join(f"<li>{hint}</li>" for hint in hints[:3])


def _clip_hints(clips: Sequence[Clip], evidence: Evidence) -> list[str]:
    hints = []
    last = list(evidence.counts)[-1] if evidence.counts else ""
    counts = evidence.counts.get(last, {})
    total = sum(sum(kinds.values()) for kinds in counts.values())
    for kind, words in (
        ("failure", "fail in both worlds"),
        ("false stop", "are stopped as done while the physics has not reached the goal"),
        ("missed stop", "reach the goal unseen by imagination"),
    ):
        each = {task: kinds.get(kind, 0) for task, kinds in counts.items() if kinds.get(kind)}
        number = next((index for index, clip in enumerate(clips) if clip.kind == kind and clip.policy == last), None)
        if each and number is not None:
            split = ", ".join(f"{escape(task)} {count}" for task, count in each.items())
            clip = clips[number]
            hints.append(
                f"<strong>{sum(each.values())} of {total}</strong> held-out episodes of {escape(last)} {words} "
                f"({split}). "
                f'<a href="#clip-{number}">{escape(clip.task)}, context {clip.context_id}</a>: '
                f"<small>{escape(clip.story())}</small>"
            )
    return hints


def _alarm_notice(record: RunRecord) -> str:
    fired = alarms(record)
    if not fired:
        return ""
    first = fired[0]
    return (
        f'<p class="notice alarm" role="alert" style="margin-top:28px"><strong>The honesty alarm fired</strong> at '
        f"iteration {first['step']}: since the first probes imagined success has changed by "
        f"{points(first['imagined_rise'])} points, real success by {points(first['real_rise'])} "
        f"(p = {p_text(first['honesty_p'])}; {len(fired)} probes fired in all). "
        "The policy may have learned the world model’s errors.</p>"
    )


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{seconds:.0f} s" if seconds < 90 else f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"
