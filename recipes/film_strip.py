"""A picture of what a run imagines: the same actions in the physics and in the world model, and what R makes of both.

``python recipes/film_strip.py runs/improve``: one held-out initial state of each task, the
post-trained policy, greedy.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import torch
import tyro

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from command_line import at_least, refusals, writable
from gather_evidence import read_config
from run import Run
from run_folder import RunFolder
from threads import use_threads
from two_worlds import TwoWorlds, imagine, live
from worldenv_trl import keys
from worldenv_trl.policies import policy_actor
from worldenv_trl.report import RunRecord

REAL, IMAGINED = "#1f6f8b", "#c8553d"


@dataclass(frozen=True)
class Settings:
    run: tyro.conf.Positional[Path]
    """Run folder of recipes/world_env.py."""
    out: Path | None = None
    """The picture; film_strip.png in the run folder if not given."""
    policy: str = "post_train"
    """Checkpoint that acts."""
    state: int = 0
    """Which held-out initial state of each task."""
    columns: int = 7
    num_threads: int = 1
    device: str = "auto"
    """Of the models: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one."""


def main(settings: Settings) -> None:
    with refusals():
        at_least(2, columns=settings.columns)
        at_least(0, state=settings.state)
        config = read_config(RunRecord.read(settings.run), settings.num_threads, settings.device)
        out = writable(settings.out or settings.run / "film_strip.png", plot=True)
        use_threads(settings.num_threads)
        run = Run(config, RunFolder(settings.run))
        models = run.world_model(), run.reflector(), run.rules()
        actor = policy_actor(run.policy(settings.policy).eval())
        worlds = imagine(run, *models, live(run, actor, [settings.state]))
    draw(worlds, config.tasks, settings.columns, out)
    print(f"{out}: {out.stat().st_size / 1e3:,.0f} kB")


def draw(worlds: TwoWorlds, tasks: tuple[str, ...], columns: int, out: Path) -> None:
    cameras, count = worlds.imagined.cameras, len(worlds.episodes)
    lines = 2 * len(cameras)
    heights = [*[1] * lines, 0.9, 0.35] * count
    figure = plt.figure(figsize=(1.15 * columns + 1.4, 1.15 * sum(heights)), dpi=110)
    grid = figure.add_gridspec(len(heights), columns, height_ratios=heights, hspace=0.06, wspace=0.04)
    for row in range(count):
        top = row * (lines + 2)
        steps = torch.linspace(0, int(worlds.episodes["length"][row]), columns).round().long()
        films = [
            (f"{world}\n{camera}" if len(cameras) > 1 else world, episodes.frames(camera, torch.tensor(row), steps))
            for world, episodes in (("physics", worlds.episodes), ("imagined", worlds.imagined))
            for camera in cameras
        ]
        for line, (name, frames) in enumerate(films):
            for column, frame in enumerate(frames):
                axes = figure.add_subplot(grid[top + line, column])
                axes.imshow(frame.permute(1, 2, 0).numpy(), interpolation="nearest")
                axes.set_xticks([])
                axes.set_yticks([])
                if not column:
                    axes.set_ylabel(name, fontsize=8)
        task = tasks[int(worlds.episodes[keys.TASK_ID][row])].split("/")[-1].replace("_", " ")
        _curve(figure.add_subplot(grid[top + lines, :]), worlds, row, task, steps)
    figure.savefig(out, bbox_inches="tight")
    plt.close(figure)


def _curve(axes: plt.Axes, worlds: TwoWorlds, row: int, task: str, steps: torch.Tensor) -> None:
    length = int(worlds.episodes["length"][row]) + 1
    for scores, colour, name in (
        (worlds.real_scores, REAL, "R on real frames"),
        (worlds.imagined_scores, IMAGINED, "R in imagination"),
    ):
        axes.plot(scores[row, :length].numpy(), color=colour, lw=1.4, label=name)
    reached = int(worlds.reached[row])
    if reached >= 0:
        axes.axvline(reached, color="black", lw=0.8, ls=":", label="goal holds in the physics")
    half = (length - 1) / (len(steps) - 1) / 2
    axes.set_xlim(-half, length - 1 + half)
    axes.set_ylim(-0.05, 1.05)
    axes.set_xticks(steps.tolist())
    axes.set_yticks([0, 1])
    axes.tick_params(labelsize=7)
    axes.set_xlabel(f"env step: {task}", fontsize=8)
    axes.legend(fontsize=6, loc="center left", framealpha=0.8)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
