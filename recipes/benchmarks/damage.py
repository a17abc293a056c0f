"""What one changed bit costs a recording: ``python recipes/benchmarks/damage.py [--flips 500]``.

Rollouts of the scenes are recorded, once when they are finished and once while they run. In copies of both files one
random bit is flipped, and what can still be read is compared with what was recorded.
"""

from __future__ import annotations

import random
import sys
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

from command_line import refusals
from threads import use_threads
from worldenv_trl import keys
from worldenv_trl.envs import TabletopEnv
from worldenv_trl.record import (
    RolloutWriter,
    list_rollouts,
    provenance,
    read_attachments,
    read_metadata,
    read_rollouts,
    recorded,
)

TASK = "starter/put_the_bowl_on_the_plate"
COMPARED = (keys.IMAGE, keys.STATE, keys.ACTION, ("next", *keys.IMAGE), ("next", "reward"))


@dataclass(frozen=True)
class Benchmark:
    """How many bits are flipped, in how large a file."""

    flips: int = 500
    """In each of the two files, one at a time."""
    rows: int = 16
    steps: int = 20
    seed: int = 0
    num_threads: int = 1


@dataclass
class Damage:
    """Counts of flips by what they cost."""

    nothing: int = 0
    rollouts: int = 0
    """Rollouts were lost, and a warning said which; the others were read bit for bit."""
    attachments: int = 0
    """An attachment was lost (the scene's own description, for instance), and a warning named it."""
    most: int = 0
    """Rollouts lost by one flip, at most."""
    unreadable: int = 0
    unnoticed: int = 0
    """Something read differs, or is missing without a warning."""


def record(folder: Path, rows: int, steps: int) -> tuple[dict[str, Path], TensorDict]:
    """The two files, and the rollouts [rows, steps] that both hold."""
    files = {kind: folder / f"{kind}.mcap" for kind in ("finished rollouts", "a recorded env")}
    env = TabletopEnv(TASK, rows, seed=0, terminate_on_success=False)
    described = provenance(env)
    env = recorded(env, files["a recorded env"], **described)
    torch.manual_seed(0)
    rollouts = env.rollout(steps)
    env.close()
    with RolloutWriter(files["finished rollouts"], **described) as writer:
        writer.write(rollouts)
    return files, rollouts


def flip(path: Path, rollouts: TensorDict, flips: int, seed: int = 0) -> Damage:
    """Flips bits of ``path``, one at a time; the file is as before in the end."""
    draw, found = random.Random(seed), Damage()
    described = read_metadata(path), read_attachments(path)
    with open(path, "r+b", buffering=0) as file:
        for _ in range(flips):
            place, bit = draw.randrange(path.stat().st_size), 1 << draw.randrange(8)
            file.seek(place)
            (byte,) = file.read(1)
            file.seek(place)
            file.write(bytes([byte ^ bit]))
            try:
                _judge(path, rollouts, described, found)
            except ValueError:
                found.unreadable += 1
            file.seek(place)
            file.write(bytes([byte]))
    return found


def _judge(path: Path, rollouts: TensorDict, described: tuple[dict, dict], found: Damage) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read, infos = read_rollouts(path), list_rollouts(path)
        same = read_metadata(path) == described[0]
        attached = read_attachments(path)
    warned = [str(warning.message) for warning in caught]
    same &= attached.items() <= described[1].items()
    length = rollouts.shape[-1]
    whole = [(info.number, row) for info, row in zip(infos, read, strict=True) if info.length == length]
    for number, row in whole:
        same &= all(torch.equal(row[key], rollouts[number][key]) for key in COMPARED)
    lost = len(rollouts) - len(whole)
    without = len(attached) < len(described[1])
    same &= not lost or any(" missing" in line for line in warned)
    same &= not without or any("damaged attachment" in line for line in warned)
    found.unnoticed += not same
    found.rollouts += same and lost > 0
    found.attachments += same and without
    found.nothing += same and not lost and not without
    found.most = max(found.most, lost)


def main(settings: Benchmark) -> None:
    with refusals():
        use_threads(settings.num_threads)
    with tempfile.TemporaryDirectory() as name:
        files, rollouts = record(Path(name), settings.rows, settings.steps)
        for kind, path in files.items():
            found = flip(path, rollouts, settings.flips, settings.seed)
            size = path.stat().st_size / 1e3
            print(f"{kind}, {size:.0f} kB, {len(rollouts)} rollouts, a bit flipped {settings.flips} times:")
            print(f"  {found.nothing} cost nothing, {found.attachments} an attachment", end=", ")
            print(f"{found.rollouts} rollouts (at most {found.most}), and it was said")
            print(f"  {found.unreadable} made the file unreadable, {found.unnoticed} were not noticed", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
