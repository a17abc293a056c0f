"""Pieces of HTML that every section is made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

__all__ = ["card", "interval", "missing", "points", "rate", "section", "table", "task_name"]


def section(name: str, title: str, say: str, *parts: str) -> str:
    """A section of the page; ``say`` (HTML) is what to see in it."""
    return f'<section id="{name}"><h2>{escape(title)}</h2><p class="say">{say}</p>{"".join(parts)}</section>'


def card(title: str, legend: Sequence[tuple[str, str]], chart: str, details: str = "", kind: str = "") -> str:
    """A chart with its title, legend (name, colour) and, folded away, its values."""
    keys = "".join(f'<span class="key {colour}">{escape(name)}</span>' for name, colour in legend)
    folded = f"<details><summary>Values</summary>{details}</details>" if details else ""
    scroll = f'<div class="scroll" tabindex="0" role="group" aria-label="{escape(title)}">{chart}</div>'
    return (
        f'<figure class="card {kind}"><figcaption>{escape(title)}</figcaption>'
        f'<div class="legend">{keys}</div>{scroll if kind else chart}{folded}</figure>'
    )


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], *, words: int = 1, label: str = "") -> str:
    """A table of HTML cells, the first ``words`` columns set as text; rows of ``all tasks`` stand out."""

    def line(tag: str, cells: Sequence[Any]) -> str:
        return "".join(
            f"<{tag}{' class=left' if index < words else ''}>{cell}</{tag[:2]}>" for index, cell in enumerate(cells)
        )

    top = line('th scope="col"', head)
    body = "".join(
        f"<tr{' class=all' if task_name('all') in row[:words] else ''}>{line('td', row)}</tr>" for row in rows
    )
    return (
        f'<div class="scroll" tabindex="0" role="group" aria-label="{escape(label or head[0] or "table")}">'
        f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def missing(what: str) -> str:
    return f'<p class="notice">{escape(what)}</p>'


def rate(value: float) -> str:
    """A share in per cent, without the sign."""
    return "–" if not math.isfinite(value) else f"{100 * value:.1f}"


def points(value: float) -> str:
    """A difference of shares in points, with its sign."""
    return f"{100 * value:+.1f}".replace("-", "−")


def interval(value: float, low: float, high: float) -> str:
    return f"{rate(value)} <small>[{rate(low)}, {rate(high)}]</small>"


def p_text(p: float) -> str:
    """A p-value as one writes it: 0.012, 3 · 10⁻⁶."""
    if p >= 0.001:
        return f"{p:.2g}"
    power = math.floor(math.log10(p)) if p > 0 else -300
    digits = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{p / 10**power:.0f} · 10{digits}"


def task_name(task: str) -> str:
    return "all tasks" if task == "all" else task.split("/")[-1].replace("_", " ")
