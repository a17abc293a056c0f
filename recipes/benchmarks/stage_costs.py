"""Seconds and peak memory of every stage, each in a process of its own (Linux).

``python recipes/benchmarks/stage_costs.py improve --run-dir runs/measured --num-threads 1``: a preset and settings as
for ``recipes/world_env.py``; the folder must be new. Memory is that of the process and its helpers together:
``resident`` is all of it, ``own`` leaves out what merely shows files and can be dropped at any time.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path

RECIPES = Path(__file__).resolve().parents[1]
STAGES = ("demonstrate", "sft", "explore", "train_world_model", "train_reflector", "post_train", "evaluate")
_EVERY = 0.3  # seconds between two looks


def family(pid: int) -> list[int]:
    """A process and all that it has started."""
    found = [pid]
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += [each for child in children.read_text().split() for each in family(int(child))]
        except OSError:  # it has just ended
            continue
    return found


def memory(pid: int) -> tuple[int, int]:
    """Resident and anonymous bytes, memory that is shared counted by halves; 0 for a process that has ended."""
    try:
        lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    except OSError:
        return 0, 0
    return tuple(1024 * int(lines[name].split()[0]) for name in ("Pss", "Pss_Anon"))  # type: ignore[return-value]


def measured(command: list[str], log: Path) -> tuple[float, float, int, int]:
    """Wall and processor seconds, peak resident and own bytes of a command.

    Raises:
        SystemExit: if it fails, naming its log.
    """
    before, started, peak = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic(), [0, 0]
    with log.open("w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        while process.poll() is None:
            each = [memory(pid) for pid in family(process.pid)]
            peak = [max(most, sum(values)) for most, values in zip(peak, zip(*each, strict=True), strict=True)]
            time.sleep(_EVERY)
    if process.returncode:
        raise SystemExit(f"error: {' '.join(command)} ended with {process.returncode}: see {log}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - started, processor, *peak


def main(arguments: list[str]) -> None:
    if "--run-dir" not in arguments:
        raise SystemExit("error: name a preset and a new --run-dir, for instance smoke --run-dir runs/measured")
    folder = Path(arguments[arguments.index("--run-dir") + 1])
    if folder.exists():
        raise SystemExit(f"error: {folder} exists: name a new --run-dir")
    if not Path("/proc/self/smaps_rollup").exists():
        raise SystemExit("error: memory is read from /proc/PID/smaps_rollup, which only Linux has")
    folder.parent.mkdir(parents=True, exist_ok=True)
    print("| stage | seconds | processor seconds | resident (GB) | own (GB) |\n|---|---|---|---|---|")
    for stage in STAGES:
        log = folder.with_name(f"{folder.name}_{stage}.log")
        seconds, processor, resident, own = measured([sys.executable, str(RECIPES / f"{stage}.py"), *arguments], log)
        print(f"| {stage} | {seconds:.0f} | {processor:.0f} | {resident / 1e9:.2f} | {own / 1e9:.2f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
