"""Learning curves of several seeds and variants in one plot, and as a table in Markdown.

``python recipes/benchmarks/learning_plot.py runs/curve_* --out learning.png``: curves of one label are the seeds of
one variant; thin lines are seeds, thick ones their mean, bands 95 % bootstrap intervals over seeds and states together
(over the states alone for one seed).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

matplotlib.use("Agg")
from matplotlib import pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from command_line import refusals, writable
from learning_curves import MODES, SPLITS, Curve, bootstrap_interval, common, read_curve


@dataclass(frozen=True)
class Settings:
    curves: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of recipes/benchmarks/learning.py."""
    out: Path = Path("learning.png")
    """The picture."""


def main(settings: Settings) -> None:
    with refusals():
        if not settings.curves:
            raise ValueError("name at least one folder")
        variants = by_label([read_curve(path) for path in settings.curves])
        out = writable(settings.out, plot=True)
        print(table(variants))
        draw(variants, out)
    print(f"\n{settings.out}")


def by_label(curves: list[Curve]) -> dict[str, list[Curve]]:
    variants: dict[str, list[Curve]] = {}
    for curve in curves:
        variants.setdefault(curve.label, []).append(curve)
    return variants


def table(variants: dict[str, list[Curve]]) -> str:
    """Success at the first and the last point that all seeds of a variant have, in per cent, and the measured r."""
    head = ("variant", "seeds", "rollouts", "r in waves", "states", "before", "after", "gain")
    lines = [head, ("---",) * len(head)]
    for label, curves in variants.items():
        for split in SPLITS:
            for mode in MODES:
                points = common(curves, split, mode)
                if not points:
                    continue
                last, strata = max(points), curves[0].tasks[split]
                before, after = points[min(points)], points[last]
                gain = after.astype(float) - before
                low, high = bootstrap_interval(gain, strata)
                numbers = (len(curves), last, f"{correlation(curves):.2f}", f"{split}, {mode}")
                ends = [_rate(values, strata) for values in (before, after)]
                lines.append(
                    (label, *map(str, numbers), *ends, f"{100 * gain.mean():+.1f} [{100 * low:.1f}, {100 * high:.1f}]")
                )
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _rate(values: np.ndarray, strata: np.ndarray) -> str:
    low, high = bootstrap_interval(values, strata)
    return f"{100 * values.mean():.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def correlation(curves: list[Curve]) -> float:
    """Of the returns that LOOP saw with the truth, within the groups of all waves that had both; NaN without any."""
    pairs = np.array([pair for curve in curves for pair in curve.correlations]).reshape(-1, 2)
    return float((pairs[:, 0] * pairs[:, 1]).sum() / pairs[:, 1].sum()) if len(pairs) else float("nan")


def draw(variants: dict[str, list[Curve]], out: Path) -> None:
    panels = [(mode, split) for mode in MODES for split in SPLITS]
    figure, grid = plt.subplots(2, 2, figsize=(10, 7), dpi=120, sharex=True, sharey=True)
    positive = [r for curves in variants.values() for c in curves for points in c.points.values() for r in points if r]
    for axes, (mode, split) in zip(grid.flat, panels, strict=True):
        for number, (label, curves) in enumerate(variants.items()):
            points, colour = common(curves, split, mode), f"C{number}"
            if not points:
                continue
            x, means = list(points), [values.mean() for values in points.values()]
            spans = [bootstrap_interval(values, curves[0].tasks[split]) for values in points.values()]
            axes.fill_between(x, *zip(*spans, strict=True), color=colour, alpha=0.15, lw=0)
            axes.plot(x, means, color=colour, lw=2, marker=".", label=f"{label} ({len(curves)})")
            for curve in curves if len(curves) > 1 else ():
                own = dict(sorted(curve.points[split, mode].items()))
                axes.plot(list(own), [values.mean() for values in own.values()], color=colour, lw=0.7, alpha=0.7)
        axes.set_title(f"{mode} success, {split} states", fontsize=10)
        axes.grid(alpha=0.3)
        if positive:
            axes.set_xscale("symlog", linthresh=min(positive), linscale=0.3)
            doubled = [min(positive) * 2**k for k in range(12) if 2**k <= max(positive) / min(positive)]
            axes.set_xticks([0, *doubled], [f"{tick:,}" for tick in (0, *doubled)], fontsize=8, rotation=30)
            axes.minorticks_off()
    for axes in grid[-1]:
        axes.set_xlabel("real rollouts")
    grid[0, 0].legend(fontsize=8, title="variant (seeds)", title_fontsize=8)
    figure.tight_layout()
    figure.savefig(out)
    plt.close(figure)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
