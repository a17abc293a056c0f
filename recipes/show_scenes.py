"""A contact sheet of the scenes: for every task, initial states, the expert at work, and where it ends.

``python recipes/show_scenes.py --suite goal --out scenes.png``, or ``--suite <folder of BDDL files>``. Of a task that
the expert has no script for the initial states alone are shown; ``--moments 0`` shows those alone of every task. A file
that cannot be shown is named, and the others are shown.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from PIL import Image
from torchrl.envs.utils import step_mdp

from command_line import at_least, refusals, writable
from task_names import SUITES
from threads import use_threads
from worldenv_trl import keys
from worldenv_trl.context_ids import SPLITS
from worldenv_trl.envs import ExpertPolicy, TabletopEnv
from worldenv_trl.scenes import RendererPool, list_tasks

_IMAGES = {"agentview": keys.IMAGE, "wrist": keys.WRIST_IMAGE}


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
    num_threads: int = 2


def main(settings: Sheet) -> None:
    with refusals():
        check(settings)
        use_threads(settings.num_threads)
    names = task_names(settings.suite)
    rows, broken = [], []
    for name in names:
        try:
            rows += task_rows(name, settings)
        except (ValueError, RuntimeError) as error:
            broken.append(name)
            print(f"{name} is not shown: {error}", file=sys.stderr)
    if not rows:
        raise SystemExit("error: none of the tasks can be shown")
    sheet = torch.cat(rows, -2).permute(1, 2, 0).repeat_interleave(settings.zoom, 0)
    sheet = sheet.repeat_interleave(settings.zoom, 1)
    with refusals():
        Image.fromarray(sheet.numpy()).save(settings.out)
    print(f"{settings.out}: {len(names) - len(broken)} tasks, {settings.columns} initial states each")
    if broken:
        raise SystemExit(f"error: {len(broken)} of {len(names)} tasks are not shown, see above")


def check(settings: Sheet) -> None:
    """Raises before any work is done."""
    at_least(1, columns=settings.columns, zoom=settings.zoom)
    at_least(16, image_size=settings.image_size)
    if settings.camera not in _IMAGES:
        raise ValueError(f"unknown --camera {settings.camera!r}: it must be one of {', '.join(_IMAGES)}")
    if settings.split not in SPLITS:
        raise ValueError(f"unknown --split {settings.split!r}: it must be one of {', '.join(SPLITS)}")
    if not settings.moments or not all(0 <= moment <= 1 for moment in settings.moments):
        shown = " ".join(map(str, settings.moments)) or "nothing"
        raise ValueError(f"--moments must be shares of an episode, each from 0 to 1, got {shown}")
    if Image.registered_extensions().get(settings.out.suffix.lower()) not in Image.SAVE:
        raise ValueError(f"--out must be the name of an image such as scenes.png, got {settings.out}")
    writable(settings.out)
    RendererPool(1).close()  # without GL this says what to install, once and not for each task


def task_names(suite: str) -> list[str]:
    """The tasks of a suite, or the BDDL files of a folder."""
    if suite in SUITES:
        return list_tasks(suite)
    if Path(suite).is_file():
        raise SystemExit(f"error: --suite {suite} is a file: name the folder that it is in")
    files = sorted(str(path) for path in Path(suite).glob("*.bddl"))
    if not files:
        if Path(suite).is_dir():
            raise SystemExit(f"error: the folder {suite} holds no .bddl file")
        known = ", ".join(SUITES)
        raise SystemExit(f"error: unknown --suite {suite!r}: it must be one of {known}, or a folder of .bddl files")
    return files


def task_rows(name: str, settings: Sheet) -> list[torch.Tensor]:
    """Images ``[3, H, columns * W]`` of one task, one for each moment; one alone without the expert."""
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
    image, data, expert = _IMAGES[settings.camera], env.reset(), None
    if any(settings.moments):
        try:
            expert = ExpertPolicy(env)
        except ValueError as error:
            print(f"{name}: initial states alone: {error}")
    if expert is None:
        env.close()
        return [torch.cat(list(data[image]), -1)]
    frames, solved = [data[image]], torch.zeros(settings.columns, dtype=torch.bool)
    while not solved.all() and len(frames) < env.tasks[0].max_steps:
        data = step_mdp(env.step(expert(data)))
        frames.append(data[image])
        solved |= data[keys.SUCCESS].squeeze(-1)
    env.close()
    print(f"{name}: the expert solved {int(solved.sum())} of {len(solved)} in at most {len(frames) - 1} steps")
    chosen = [frames[round(moment * (len(frames) - 1))] for moment in settings.moments]
    return [torch.cat(list(images), -1) for images in chosen]


if __name__ == "__main__":
    main(tyro.cli(Sheet, description=__doc__))
