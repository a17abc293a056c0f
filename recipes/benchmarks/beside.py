"""How far beside a path that succeeds another one still does, in the physics and in the eyes of the path's judge.

``python recipes/benchmarks/beside.py runs/improve``. Explored rollouts that reached the goal, from initial states that
the judge was not trained on, are played again with the hand moved by so many centimetres, in a direction drawn for
each; what the physics makes of it is held against R at the end of the same path. Noise moves a hand to and fro, what
LOOP does to a policy moves it to one side: where R does not fall as success does, LOOP is led astray.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
import tyro
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from command_line import at_least, refusals, writable
from episodes import demonstrations_and_exploration, split_by_context
from gather_evidence import read_config
from run import Run
from run_folder import RunFolder
from threads import use_threads
from two_worlds import relive
from worldenv_trl import keys
from worldenv_trl.data import Episodes, score_episodes
from worldenv_trl.metrics import wilson_interval
from worldenv_trl.reflectors import Reflector
from worldenv_trl.report import RunRecord

MOVED_IN = 12  # steps: before a hand has come down


@dataclass(frozen=True)
class Settings:
    run: tyro.conf.Positional[Path]
    """Run folder of recipes/world_env.py."""
    reflector: str = "reflector"
    """Checkpoint of the run, or folder of one; what judges imagination there must read paths alone."""
    distances: tuple[float, ...] = (0.0, 0.003, 0.01, 0.02, 0.04, 0.08)
    """By how much hands are moved (m)."""
    episodes_per_task: int = 40
    """Successes of a task at most."""
    seed: int = 0
    """Of the directions."""
    out: Path | None = None
    """JSON of all figures; beside_REFLECTOR.json in the run folder if not given."""
    num_threads: int = 1


def main(settings: Settings) -> Path:
    with refusals():
        at_least(1, episodes_per_task=settings.episodes_per_task)
        if not settings.distances or min(settings.distances) < 0:
            raise ValueError(f"--distances must be one or more, none negative, got {settings.distances}")
        use_threads(settings.num_threads)
        config = read_config(RunRecord.read(settings.run), settings.num_threads, "cpu")
        run = Run(config, RunFolder(settings.run))
        path = run.folder.named_checkpoint(settings.reflector, "train_reflector")
        out = writable(settings.out or settings.run / f"beside_{path.name}.json")
        judge = run.parts.reflector.load(path).eval().for_world("imagined")
        if judge.reads_video:
            raise ValueError(f"the judge in {path} looks at videos, of which there are none here: it must read paths")
        successes = kept_out_successes(run, settings.episodes_per_task)
        figures = measure(run, judge, successes, settings)
    out.write_text(json.dumps(figures, indent=1) + "\n")
    print(table(figures))
    print(f"{out}: all figures")
    return out


def kept_out_successes(run: Run, per_task: int) -> Episodes:
    """Explored ones, as the policy lived them, of initial states that no reflector was trained on.

    Raises:
        ValueError: if there is none.
    """
    config = run.config
    _, explored = demonstrations_and_exploration(run, 1)
    _, kept_out = split_by_context(explored, config.reflector.holdout, run.seed("held-out contexts"))
    task, reached = kept_out[keys.TASK_ID].squeeze(-1), kept_out["success"].any(-1)
    rows = [((task == number) & reached).nonzero().squeeze(-1)[:per_task] for number in range(len(config.tasks))]
    if not sum(map(len, rows)):
        raise ValueError(f"no explored rollout of {run.folder.path} that was kept out reached the goal: explore more")
    return kept_out[torch.cat(rows)]


def measure(run: Run, judge: Reflector, successes: Episodes, settings: Settings) -> dict[str, Any]:
    """For each task, and all: number of paths, and at each distance successes and the mean of R."""
    drawn = torch.Generator().manual_seed(settings.seed)
    task, first = successes[keys.TASK_ID].squeeze(-1), successes["kinematic_states"][:, 0]
    rows = {"all": torch.ones_like(task, dtype=torch.bool)}
    rows |= {name: task == number for number, name in enumerate(run.config.tasks)}
    out: dict[str, Any] = {name: {"paths": int(chosen.sum()), "at": {}} for name, chosen in rows.items()}
    towards = directions(len(successes), drawn)
    for distance in settings.distances:
        moved = moved_aside(successes["actions"], distance * towards)
        episodes = successes[:]
        after = run.kinematics.rollout(first, moved)
        episodes["actions"], episodes["kinematic_states"] = moved, torch.cat([first.unsqueeze(1), after], 1)
        reached = relive(run, episodes).any(-1)
        scores = score_episodes(judge, episodes)[:, -1]
        for name, chosen in rows.items():
            if chosen.any():
                figures = {"successes": int(reached[chosen].sum()), "R": scores[chosen].mean().item()}
                out[name]["at"][f"{distance:g}"] = figures | _by_outcome(scores[chosen], reached[chosen])
    return out


def directions(count: int, drawn: torch.Generator) -> Tensor:
    """Unit vectors [n, 3], all directions alike."""
    return F.normalize(torch.randn(count, 3, generator=drawn), dim=-1)


def moved_aside(actions: Tensor, shifts: Tensor) -> Tensor:
    """Actions [n, T, 7] that take the hand to the same path moved by ``shifts`` [n, 3] (m), and along it.

    Less far where an action would exceed [-1, 1].
    """
    moved = actions.clone()
    moved[:, :MOVED_IN, :3] += shifts.unsqueeze(1) / (MOVED_IN * keys.POSITION_STEP)
    return moved.clamp(-1, 1)


def _by_outcome(scores: Tensor, reached: Tensor) -> dict[str, float | None]:
    """Mean R of those that succeed, and of those that fail; None where there is none."""
    named = (("R_of_successes", scores[reached]), ("R_of_failures", scores[~reached]))
    return {name: each.mean().item() if len(each) else None for name, each in named}


def table(figures: dict[str, Any]) -> str:
    """Success in the physics and mean R at each distance."""
    distances = list(figures["all"]["at"])
    moved = " | ".join(f"{100 * float(each):g} cm" for each in distances)
    lines = [f"| paths that succeed, the hand moved by | {moved} |", "|---" * (len(distances) + 1) + "|"]
    for name, found in figures.items():
        count, cells = found["paths"], found["at"].values()
        if count:
            lines.append(f"| {name} ({count}): physics | " + " | ".join(_rate(each, count) for each in cells) + " |")
            lines.append("| R | " + " | ".join(f"{each['R']:.2f}" for each in cells) + " |")
    return "\n".join(lines)


def _rate(cell: dict[str, Any], count: int) -> str:
    low, high = wilson_interval(cell["successes"], count)
    return f"{cell['successes'] / count:.2f} [{low:.2f}, {high:.2f}]"


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
