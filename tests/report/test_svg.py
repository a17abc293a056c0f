from __future__ import annotations

import itertools
import math
import re
import xml.etree.ElementTree as ElementTree

import pytest

from worldenv_trl.report.svg import Row, Series, interval_chart, line_chart, path_of, percent, ticks


def parsed(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def test_ticks_are_round_and_cover_the_range():
    assert ticks(0, 1) == [0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert ticks(13, 38) == [15, 20, 25, 30, 35]
    assert all(-0.003 <= tick <= 0.004 for tick in ticks(-0.003, 0.004)) and len(ticks(-0.003, 0.004)) >= 3


def test_a_value_that_is_not_finite_leaves_a_gap():
    assert path_of([(0, 1), (1, math.nan), (2, 3), (3, 4)]) == "M0.0 1.0M2.0 3.0L3.0 4.0"


def test_a_line_is_drawn_to_scale_with_its_band_and_its_last_value():
    line = Series("real", "real", [0, 10], [0.0, 0.5], [0.0, 0.4], [0.1, 0.6], dots=True)
    svg = line_chart([line], label="success", x_label="step", y_label="", y_range=(0, 1), fmt=percent)
    root = parsed(svg)
    dots = [(float(dot.get("cx")), float(dot.get("cy"))) for dot in root.iter("circle")]
    assert dots[0][0] == 46 and dots[0][1] == 230  # left edge, zero
    assert dots[1][1] == pytest.approx((230 + 24) / 2)  # half of the height
    assert len(root.findall("polygon")) == 1 and root.get("aria-label") == "success"
    assert [text.text for text in root.findall("text") if "value" in text.get("class")] == ["50 %"]
    assert "real, 10: 50 % [40 %, 60 %]" in svg


def test_last_values_that_are_close_do_not_cover_each_other():
    lines = [Series(str(k), "plain", [0, 1], [0.5, 0.5 + 0.001 * k]) for k in range(4)]
    root = parsed(line_chart(lines, label="", x_label="", y_label="", y_range=(0, 0.503)))
    heights = sorted(float(text.get("y")) for text in root.findall("text") if "value" in text.get("class"))
    assert all(below - above >= 12.9 for above, below in itertools.pairwise(heights))


def test_intervals_are_drawn_and_written():
    rows = [Row("all <tasks>", [("before", "before", 0.5, 0.4, 0.6), ("after", "after", 0.7, 0.6, 0.8)], "n = 9")]
    svg = interval_chart(rows, label="success")
    lines = [line for group in parsed(svg).iter("g") for line in group.findall("line")]
    widths = [float(line.get("x2")) - float(line.get("x1")) for line in lines]
    assert widths == pytest.approx([0.2 * 590, 0.2 * 590], abs=0.2)
    assert "70.0 [60.0, 80.0]" in svg and "all &lt;tasks&gt;" in svg
    assert not re.search(r"nan|inf", svg)
