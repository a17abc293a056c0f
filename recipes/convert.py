"""Recordings to LeRobot v3 folders and back, and LIBERO's or robomimic's demonstrations to recordings.

python recipes/convert.py runs/demo/rollouts/explore.mcap data/explore_lerobot
python recipes/convert.py data/explore_lerobot data/explore.mcap
python recipes/convert.py data/libero_goal/open_the_middle_drawer_of_the_cabinet_demo.hdf5 data/drawer.mcap
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from worldenv_trl.data import hdf5_to_mcap, read_lerobot, write_lerobot
from worldenv_trl.record import RolloutWriter, read_rollouts


@dataclass(frozen=True)
class Options:
    source: tyro.conf.Positional[Path]
    """A recording (.mcap), a LeRobot folder, or a .hdf5 file."""
    target: tyro.conf.Positional[Path]
    """A folder for a recording, a recording for the others."""
    video: bool = False
    """LeRobot: MP4 files instead of images; without loss, too."""
    alignment: str = "stored"
    """HDF5: which observation goes with an action, stored or executed (see data/README.md)."""
    overwrite: bool = False
    """Replace the target."""


def main(options: Options) -> int:
    source, target = options.source, options.target
    try:
        if source.suffix == ".mcap":
            rollouts = read_rollouts(source)
            write_lerobot(rollouts, target, video=options.video, overwrite=options.overwrite)
            count = rollouts.shape[:-1].numel()
        elif source.suffix in (".hdf5", ".h5"):
            count = hdf5_to_mcap(source, target, alignment=options.alignment, overwrite=options.overwrite)
        else:
            rollouts = read_lerobot(source)
            with RolloutWriter(target, metadata={"source": source.name}, overwrite=options.overwrite) as writer:
                writer.write(rollouts)
            count = len(rollouts)
    except (ValueError, OSError, ImportError) as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{target}: {count} rollouts")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
