"""Shows recorded rollouts: ``python recipes/view.py runs/demo/rollouts/explore.mcap --rollout 3``.

Rerun opens with images, the action map, the hand's path, text and plots, or ``--save rollout.rrd`` keeps all that in a
file (no display is needed). With ``--viewer foxglove`` a layout is written for the file, and Foxglove is started if it
is installed.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from command_line import one_line_errors
from worldenv_trl.record import list_rollouts
from worldenv_trl.record.view import foxglove_layout, require_rerun, rerun_recording

MOST = 16  # rollouts that are shown if none is named


@dataclass(frozen=True)
class Options:
    file: tyro.conf.Positional[Path]
    """A recording."""
    rollout: tuple[int, ...] = ()
    """Numbers of rollouts; Rerun shows the first 16 if none is given, Foxglove all (where they begin is printed)."""
    viewer: Literal["rerun", "foxglove"] = "rerun"
    save: Path | None = None
    """Write this file (.rrd for Rerun, .json for Foxglove's layout) instead of opening a window."""
    overwrite: bool = False
    """Replace a file that exists."""


@one_line_errors
def main(options: Options) -> int:
    if options.file.is_dir():
        raise ValueError(f"{options.file} is a folder: name one recording to show")
    if not options.file.exists():
        raise FileNotFoundError(f"there is no file {options.file}")
    suffix = ".json" if options.viewer == "foxglove" else ".rrd"
    if options.save is not None and options.save.suffix != suffix:
        raise ValueError(f"--save must end in {suffix} for {options.viewer}, got {options.save}")
    if options.save is not None and options.save.exists() and not options.overwrite:
        raise FileExistsError(f"{options.save} exists: pass --overwrite or another name")
    return _foxglove(options) if options.viewer == "foxglove" else _rerun(options)


def _rerun(options: Options) -> int:
    require_rerun()
    if options.save is None and not has_display():
        raise OSError("there is no display to open a window on: pass --save rollouts.rrd and open that elsewhere")
    recording = rerun_recording(options.file, options.rollout or slice(MOST))
    if not options.rollout and (count := len(list_rollouts(options.file))) > MOST:
        print(f"the first {MOST} of {count} rollouts: name others with --rollout")
    if options.save is None:
        recording.spawn()
        return 0
    options.save.parent.mkdir(parents=True, exist_ok=True)
    partial = options.save.with_name(options.save.name + ".partial")
    recording.save(partial)
    recording.disconnect()
    os.replace(partial, options.save)
    print(f"{options.save}: open it with rerun {options.save}")
    return 0


def _foxglove(options: Options) -> int:
    layout = json.dumps(foxglove_layout(options.file), indent=1)
    infos = {info.number: info for info in list_rollouts(options.file)} if options.rollout else {}
    for number in options.rollout:
        if number not in infos:
            raise ValueError(
                f"{options.file} holds {f'the rollouts 0 to {max(infos)}, not' if infos else 'no rollout'} {number}"
            )
    target = options.save or options.file.with_name(f"{options.file.stem}.foxglove.json")
    if target.exists() and not options.overwrite and target.read_text() != layout:
        raise FileExistsError(f"{target} exists: pass --overwrite or --save another name")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(layout)
    program = shutil.which("foxglove-studio") or shutil.which("foxglove")
    if options.save is None and program is not None and has_display():
        subprocess.Popen([program, str(options.file.resolve())], start_new_session=True)
    else:
        print(f"open {options.file} in Foxglove (desktop or app.foxglove.dev)")
    print(f"layout: {target} (Foxglove: Layouts, Import from file)")
    for number in options.rollout:
        print(f"rollout {number} begins at {infos[number].start:.2f} s of the time line: {infos[number].instruction}")
    return 0


def has_display() -> bool:
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
