"""Charts as inline SVG. Colours are CSS classes (``real``, ``imagined``, ``before``, ``after``, ``plain``)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape

__all__ = ["Row", "Series", "interval_chart", "line_chart", "path_of", "percent", "ticks"]

_LEFT, _TOP, _BOTTOM = 46, 24, 40


def percent(value: float) -> str:
    return f"{100 * value:.0f} %"


def plain(value: float) -> str:
    return f"{value:.3g}"


@dataclass(frozen=True)
class Series:
    """A line: ``low`` and ``high`` draw its interval as a band; NaN leaves a gap."""

    name: str
    colour: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] = ()
    high: Sequence[float] = ()
    dashed: bool = False
    dots: bool = False


@dataclass(frozen=True)
class Row:
    """A line of an interval chart: ``values`` are (series, colour, value, low, high)."""

    name: str
    values: list[tuple[str, str, float, float, float]] = field(default_factory=list)
    note: str = ""


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers that cover [low, high], about ``count`` of them."""
    span = max(high - low, 1e-12)
    power = 10 ** math.floor(math.log10(span / count))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= span / count * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]


def path_of(points: Sequence[tuple[float, float]]) -> str:
    """An SVG path through the points; one that is not finite leaves a gap."""
    parts, pen_down = [], False
    for x, y in points:
        if math.isfinite(y):
            parts.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
        pen_down = math.isfinite(y)
    return "".join(parts)


def line_chart(
    series: Sequence[Series],
    *,
    label: str,
    x_label: str,
    y_label: str,
    y_range: tuple[float, float] | None = None,
    x_range: tuple[float, float] | None = None,
    fmt: Callable[[float], str] = plain,
    width: int = 460,
    height: int = 270,
    marks: Sequence[tuple[float, str]] = (),
    diagonal: bool = False,
) -> str:
    """Lines with their bands; each line's last value is written at its end, every point has a tooltip.

    Args:
        series: at least one with a finite value.

    Keyword Args:
        label: what the chart shows, for those who hear it.
        y_range, x_range: drawn at least; the data's own by default.
        fmt: of values.
        marks: vertical lines (x, text).
        diagonal: draw y = x.
    """
    right = 58
    xs = [float(x) for line in series for x in line.x]
    ys = [float(v) for line in series for v in (*line.y, *line.low, *line.high) if math.isfinite(v)]
    x0, x1 = x_range or (min(xs), max(xs))
    y0, y1 = y_range or (min(ys), max(ys))
    if y_range is None:
        pad = 0.06 * max(y1 - y0, 1e-9)
        y0, y1 = y0 - pad, y1 + pad
    x1, y1 = (x1 if x1 > x0 else x0 + 1), (y1 if y1 > y0 else y0 + 1)

    def px(x: float) -> float:
        return _LEFT + (x - x0) / (x1 - x0) * (width - _LEFT - right)

    def py(y: float) -> float:
        return height - _BOTTOM - (min(max(y, y0), y1) - y0) / (y1 - y0) * (height - _TOP - _BOTTOM)

    out = [_open(width, height, label)]
    for value in ticks(y0, y1):
        out.append(f'<line class="grid" x1="{_LEFT}" x2="{width - right}" y1="{py(value):.1f}" y2="{py(value):.1f}"/>')
        out.append(_text(_LEFT - 7, py(value) + 4, (percent if fmt is percent else plain)(value), "end"))
    for value in ticks(x0, x1, 6):
        out.append(_text(px(value), height - _BOTTOM + 17, f"{value:g}", "middle"))
    out.append(_text((_LEFT + width - right) / 2, height - 6, x_label, "middle", "axis"))
    out.append(_text(4, 11, y_label, "start", "axis"))
    for x, words in marks:
        out.append(f'<line class="mark" x1="{px(x):.1f}" x2="{px(x):.1f}" y1="{_TOP}" y2="{height - _BOTTOM}"/>')
        out.append(_text(px(x) + 4, _TOP + 10, words, "start", "axis"))
    if diagonal:
        ends = max(x0, y0), min(x1, y1)
        points = " ".join(f"{px(v):.1f},{py(v):.1f}" for v in ends)
        out.append(f'<polyline class="mark" points="{points}"/>')
    for line in series:
        out += _line(line, px, py, fmt)
    out += _end_labels(series, px, py, fmt, height)
    return "".join([*out, "</svg>"])


def _line(line: Series, px: Callable, py: Callable, fmt: Callable) -> Iterator[str]:
    for piece in _bands(line):
        there = [f"{px(x):.1f},{py(high):.1f}" for x, _, high in piece]
        back = [f"{px(x):.1f},{py(low):.1f}" for x, low, _ in reversed(piece)]
        yield f'<polygon class="band {line.colour}" points="{" ".join(there + back)}"/>'
    points = [(px(x), py(y) if math.isfinite(y) else math.nan) for x, y in zip(line.x, line.y, strict=True)]
    dash = " dashed" if line.dashed else ""
    yield f'<path class="line {line.colour}{dash}" d="{path_of(points)}"/>'
    radius = 3 if line.dots else 7
    for index, (x, y) in enumerate(points):
        if math.isfinite(y):
            words = f"{line.name}, {line.x[index]:g}: {fmt(line.y[index])}"
            if len(line.low):
                words += f" [{fmt(line.low[index])}, {fmt(line.high[index])}]"
            kind = f"dot {line.colour}" if line.dots else "target"
            tip = f"<title>{escape(words)}</title>"
            yield f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{radius}">{tip}</circle>'


def _bands(line: Series) -> list[list[tuple[float, float, float]]]:
    pieces: list[list[tuple[float, float, float]]] = [[]]
    for x, low, high in zip(line.x, line.low, line.high, strict=False):
        if math.isfinite(low) and math.isfinite(high):
            pieces[-1].append((x, low, high))
        elif pieces[-1]:
            pieces.append([])
    return [piece for piece in pieces if len(piece) > 1]


def _end_labels(series: Sequence[Series], px: Callable, py: Callable, fmt: Callable, height: int) -> list[str]:
    """The last value of each line beside its end, moved apart where they would overlap."""
    ends = []
    for line in series:
        finite = [(x, y) for x, y in zip(line.x, line.y, strict=True) if math.isfinite(y)]
        if finite:
            ends.append([py(finite[-1][1]), px(finite[-1][0]), line.colour, fmt(finite[-1][1])])
    ends.sort(key=lambda end: end[0])
    for above, below in itertools.pairwise(ends):
        below[0] = max(below[0], above[0] + 13)
    overflow = ends[-1][0] - (height - _BOTTOM + 4) if ends else 0
    if overflow > 0:
        ends[-1][0] -= overflow
        for below, above in zip(ends[::-1], ends[-2::-1], strict=False):
            above[0] = min(above[0], below[0] - 13)
    return [_text(x + 7, y + 4, words, "start", f"value {colour}") for y, x, colour, words in ends]


def interval_chart(rows: Sequence[Row], *, label: str, x_range: tuple[float, float] = (0, 1), width: int = 1000) -> str:
    """Values with their intervals, one group of lines for each row, figures written beside them."""
    left, right, line_height = 220, 190, 22
    heights = [line_height * max(1, len(row.values)) + 16 for row in rows]
    height = sum(heights) + 36

    def px(x: float) -> float:
        return left + (x - x_range[0]) / (x_range[1] - x_range[0]) * (width - left - right)

    out, top = [_open(width, height, label)], 6.0
    for value in ticks(*x_range):
        out.append(f'<line class="grid" x1="{px(value):.1f}" x2="{px(value):.1f}" y1="4" y2="{height - 28}"/>')
        out.append(_text(px(value), height - 10, percent(value), "middle"))
    for row, space in zip(rows, heights, strict=True):
        middle = top + (space - 16) / 2 + 4
        out.append(_text(left - 16, middle + (-3 if row.note else 4), row.name, "end", "name"))
        if row.note:
            out.append(_text(left - 16, middle + 14, row.note, "end", "axis"))
        for index, (name, colour, value, low, high) in enumerate(row.values):
            y = top + line_height * (index + 0.5)
            words = f"{100 * value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
            out.append(f'<g class="whisker {colour}"><title>{escape(f"{row.name}, {name}: {words} %")}</title>')
            out.append(f'<line x1="{px(low):.1f}" x2="{px(high):.1f}" y1="{y}" y2="{y}"/>')
            out.append(f'<circle cx="{px(value):.1f}" cy="{y}" r="5"/></g>')
            out.append(_text(width - right + 18, y + 4, words, "start", f"value {colour}"))
        top += space
    return "".join([*out, "</svg>"])


def _open(width: float, height: float, label: str) -> str:
    return f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">'


def _text(x: float, y: float, words: str, anchor: str, kind: str = "tick") -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'
