"""Recordings to LeRobot v3 folders and back, and LIBERO's or robomimic's demonstrations to recordings.

python recipes/convert.py runs/demo/rollouts/explore.mcap data/explore_lerobot
python recipes/convert.py data/explore_lerobot data/explore.mcap
python recipes/convert.py data/libero_goal/open_the_middle_drawer_of_the_cabinet_demo.hdf5 data/drawer.mcap
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from command_line import one_line_errors
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
    alignment: Literal["stored", "executed"] = "stored"
    """HDF5: which observation goes with an action, stored or executed (see data/README.md)."""
    overwrite: bool = False
    """Replace the target."""


@one_line_errors
def main(options: Options) -> int:
    source, target = options.source, options.target
    if not source.exists():
        raise FileNotFoundError(f"there is no {'file' if source.suffix else 'folder'} {source}")
    if source.is_dir() and not (source / "meta").exists() and any(source.glob("*.mcap")):
        raise ValueError(f"{source} is a folder of recordings: convert them one by one")
    if source.is_file() and source.suffix not in (".mcap", ".hdf5", ".h5"):
        raise ValueError(f"{source} is neither a recording (.mcap), an HDF5 file (.hdf5, .h5) nor a LeRobot folder")
    if source.suffix == ".mcap" and target.suffix in (".mcap", ".hdf5", ".h5"):
        raise ValueError(f"a recording becomes a LeRobot folder: give a folder's name instead of {target}")
    if source.suffix != ".mcap" and target.suffix != ".mcap":
        raise ValueError(f"{source} becomes a recording: give a name that ends in .mcap instead of {target}")
    if options.video and source.suffix != ".mcap":
        raise ValueError(f"--video is for what becomes a LeRobot folder, and {source} becomes a recording")
    if options.alignment != "stored" and source.suffix not in (".hdf5", ".h5"):
        raise ValueError(f"--alignment is for HDF5 files, {source} is none")
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
    print(f"{target}: {count} rollouts")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
