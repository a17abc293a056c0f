"""Makes damaged or unfinished recordings whole again: ``python recipes/repair.py runs/demo/rollouts/*.partial.mcap``.

Every complete message is kept, in ``<name>.repaired.mcap`` beside each file; the files themselves stay as they are.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import tyro

from command_line import in_options
from worldenv_trl.record import list_rollouts, repair


@dataclass(frozen=True)
class Options:
    files: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings."""
    overwrite: bool = False
    """Replace repaired files that exist already."""


def main(options: Options) -> int:
    if not options.files:
        print("error: name at least one recording to repair", file=sys.stderr)
        return 1
    failed = 0
    for path in options.files:
        try:
            if path.is_dir():
                raise ValueError(f"{path} is a folder: name the recordings in it")
            done = repair(path, overwrite=options.overwrite)
        except (ValueError, OSError) as error:
            print(f"error: {in_options(error)}", file=sys.stderr)
            failed += 1
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rollouts = list_rollouts(done.target)
        steps = sum(rollout.length for rollout in rollouts)
        print(f"{done.target}: {done.messages} messages, {len(rollouts)} rollouts, {steps} steps")
        for line in done.lost:
            print(f"  the original {line}")
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
