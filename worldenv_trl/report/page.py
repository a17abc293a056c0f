"""The single-file HTML report of a run: nothing in it is fetched from anywhere."""

from __future__ import annotations

import os
from html import escape
from importlib.resources import files
from pathlib import Path

from worldenv_trl.report import sections
from worldenv_trl.report.evidence import KINDS, Evidence, RunRecord
from worldenv_trl.report.filmstrip import clip_card
from worldenv_trl.report.judgement import reflector
from worldenv_trl.report.markup import missing, section, table
from worldenv_trl.report.verdict import headline

__all__ = ["render_report", "write_report"]

_SECTIONS = (
    ("success", "Success"),
    ("learning", "Learning"),
    ("honesty", "Imagined vs real"),
    ("drift", "Drift"),
    ("reflector", "Reflector"),
    ("episodes", "Episodes"),
    ("config", "Config"),
)


def write_report(record: RunRecord, path: str | Path, evidence: Evidence | None = None) -> Path:
    """Writes the report of a run to ``path``, in place of an older one only when complete.

    Args:
        record: the run.
        path: an ``.html`` file; its folder must exist.
        evidence: what was measured on the run's models; the report says what is missing without it.

    Raises:
        OSError: if the file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(render_report(record, evidence), encoding="utf-8")
    os.replace(temporary, path)
    return path


def render_report(record: RunRecord, evidence: Evidence | None = None) -> str:
    """The page as text; see :func:`write_report`."""
    here = files("worldenv_trl.report")
    style, script = ((here / name).read_text(encoding="utf-8") for name in ("style.css", "script.js"))
    links = "".join(f'<a href="#{name}">{escape(title)}</a>' for name, title in _SECTIONS)
    body = "".join((
        headline(record, evidence),
        f'<nav aria-label="Sections">{links}</nav>',
        sections.success(record),
        sections.learning(record),
        sections.honesty(record, evidence),
        sections.drift(evidence),
        reflector(record, evidence),
        _episodes(evidence),
        sections.settings(record, evidence),
    ))  # fmt: skip
    name = escape(record.path.resolve().name)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{name}: report</title><link rel="icon" href="data:,"><style>{style}</style></head>'
        f"<body><main>{body}</main><script>{script}</script></body></html>\n"
    )


def _episodes(evidence: Evidence | None) -> str:
    say = (
        "Held-out initial states. Upper frames: what the camera saw; lower frames: what the world model made of the "
        "same actions; below, on the same axis, R on either video and the gripper’s opening (grey). Play the video, "
        "click into the strip, or step with the arrow keys (shift: eight steps)."
    )
    if not evidence or not evidence.counts:
        reasons = "; ".join(evidence.missing) if evidence else "the models were not asked (--no-models)"
        return section("episodes", "Episodes", say, missing(f"Missing: film strips. {reasons}."))
    head = ("policy", "task", "episodes", *(_plural(kind).lower() for kind in KINDS))
    rows = [
        (escape(policy), escape(task), sum(kinds.values()), *(kinds.get(kind, 0) for kind in KINDS))
        for policy, tasks in evidence.counts.items()
        for task, kinds in tasks.items()
    ]
    parts = [table(head, rows, words=2)]
    for kind, words in KINDS.items():
        shown = [(index, clip) for index, clip in enumerate(evidence.clips) if clip.kind == kind]
        parts.append(f'<h3 id="{kind.replace(" ", "-")}">{_plural(kind)}</h3>')
        parts.append(f'<p class="say" style="margin-bottom:0">{words}.</p>')
        parts += [clip_card(clip, index) for index, clip in shown]
        if not shown:
            parts.append(missing(f"No {kind} is shown: there is none among the episodes, or none was asked for."))
    return section("episodes", "Episodes", say, *parts)


def _plural(kind: str) -> str:
    return {"success": "Successes", "failure": "Failures"}.get(kind, kind.capitalize() + "s")
