"""A contact sheet of the scenes: for every task, initial states, the expert at work, and where it ends.

``python recipes/show_scenes.py --suite goal --out scenes.png``, or ``--suite <folder of BDDL files>``, of
which the initial states alone are shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from PIL import Image
from torchrl.envs.utils import step_mdp

from worldenv_trl import keys
from worldenv_trl.envs import ExpertPolicy, TabletopEnv
from worldenv_trl.scenes import list_suites, list_tasks, load_task


@dataclass(frozen=True)
class Sheet:
    """What is shown, and how large."""

    out: Path = Path("scenes.png")
    suite: str = "goal"
    """A suite (``starter`` is the recipes' own), or a folder of BDDL files."""
    split: str = "train"
    columns: int = 10
    """Initial states of each task, the first ones of the split."""
    image_size: int = 64
    camera: str = "agentview"
    zoom: int = 2
    """Each pixel is drawn this many times wide and high."""
    moments: tuple[float, ...] = (0.0, 0.3, 1.0)
    """Rows of each task, as shares of its longest episode."""


def main(settings: Sheet) -> None:
    names = task_names(settings.suite)
    rows = [row for name in names for row in task_rows(name, settings)]
    sheet = torch.cat(rows, -2).permute(1, 2, 0).repeat_interleave(settings.zoom, 0)
    sheet = sheet.repeat_interleave(settings.zoom, 1)
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(sheet.numpy()).save(settings.out)
    print(f"{settings.out}: {len(names)} tasks, {settings.columns} initial states each")


def task_names(suite: str) -> list[str]:
    """The tasks of a suite, or the BDDL files of a folder."""
    if suite in (*list_suites(), "starter"):
        return list_tasks(suite)
    files = sorted(str(path) for path in Path(suite).glob("*.bddl"))
    if not files:
        known = ", ".join([*list_suites(), "starter"])
        raise SystemExit(f"unknown suite {suite!r}: it must be one of {known}, or a folder of .bddl files")
    return files


def task_rows(name: str, settings: Sheet) -> list[torch.Tensor]:
    """Images ``[3, H, columns * W]`` of one task, one for each moment."""
    env = TabletopEnv(
        name,
        settings.columns,
        image_size=settings.image_size,
        cameras=(settings.camera,),
        init_split=settings.split,
        init_state_mode="cycle",
        init_state_count=settings.columns,
        terminate_on_success=False,
        seed=0,
    )
    image = keys.IMAGE if settings.camera == "agentview" else ("observation", "wrist_image")
    if name.endswith(".bddl"):
        images = env.reset()[image]
        env.close()
        return [torch.cat(list(images), -1)]
    expert, data = ExpertPolicy(env), env.reset()
    frames, solved = [data[image]], torch.zeros(settings.columns, dtype=torch.bool)
    while not solved.all() and len(frames) < load_task(name).max_steps:
        data = step_mdp(env.step(expert(data)))
        frames.append(data[image])
        solved |= data[keys.SUCCESS].squeeze(-1)
    env.close()
    print(f"{name}: the expert solved {int(solved.sum())} of {len(solved)} in at most {len(frames) - 1} steps")
    chosen = [frames[round(moment * (len(frames) - 1))] for moment in settings.moments]
    return [torch.cat(list(images), -1) for images in chosen]


if __name__ == "__main__":
    main(tyro.cli(Sheet, description=__doc__))
