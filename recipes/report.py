"""One self-contained HTML file that says what a run came to, and why its policy fails where it fails.

``python recipes/report.py runs/improve`` writes ``runs/improve/report.html``. Beside the logged figures it plays the
policies before and after on held-out initial states, in the physics and in imagination (about a minute on one core);
``--no-models`` leaves that out. What a run does not hold yet is named in the report.
"""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path

import tyro

from command_line import refusals
from gather_evidence import gather, short
from parts import Parts
from threads import use_threads
from worldenv_trl.devices import choose_device
from worldenv_trl.pretrained import OtherClassError
from worldenv_trl.report import Evidence, RunRecord, write_report


@dataclass(frozen=True)
class Report:
    run: tyro.conf.Positional[Path]
    """Run folder of recipes/world_env.py."""
    out: Path | None = None
    """The file to write; report.html in the run folder by default."""
    models: bool = True
    """Play the policies and ask world model and reflector; without, only the logged figures are shown."""
    episodes_per_task: int = 20
    """Held-out initial states of each task that both policies play."""
    clips_per_kind: int = 3
    """Film strips of each kind of episode."""
    num_threads: int = 1
    device: str = "auto"
    """Of the models: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one."""
    show: bool = False
    """Open the report in the browser."""


def main(settings: Report) -> Path:
    with refusals():
        out = write(settings)
    if settings.show:
        webbrowser.open(out.resolve().as_uri())
    return out


def write(settings: Report, parts: Parts | None = None) -> Path:
    """Writes the report and says where it is, and what is missing in it; the parts are those that the run's settings
    name unless others are given.

    Raises:
        OSError: if there is no run folder, or the report cannot be written.
        ValueError: for settings out of range, a run whose settings cannot be read, or models of other parts.
    """
    record = RunRecord.read(settings.run)
    out = settings.run / "report.html" if settings.out is None else settings.out
    if out.is_dir():
        raise IsADirectoryError(f"--out must be a file, {out} is a folder")
    if not out.parent.is_dir():
        raise FileNotFoundError(f"the folder {out.parent} does not exist: make it, or choose another --out")
    if settings.episodes_per_task < 1 or settings.clips_per_kind < 0:
        raise ValueError(
            "episodes-per-task must be at least 1 and clips-per-kind at least 0, "
            f"got {settings.episodes_per_task} and {settings.clips_per_kind}"
        )
    choose_device(settings.device)
    use_threads(settings.num_threads)
    evidence = None
    if settings.models:
        try:
            counts = settings.episodes_per_task, settings.clips_per_kind
            evidence = gather(record, *counts, settings.num_threads, parts, settings.device)
        except OtherClassError as error:  # a report of these models may be there already
            own = "parts of your own are passed as recipes/README.md says: report.write(report.Report(folder), parts)"
            raise ValueError(f"{short(error)}; {own}; --no-models shows the logged figures alone") from error
        except (OSError, ValueError, RuntimeError) as error:  # the logged figures are shown all the same
            evidence = Evidence(missing=[short(error)])
        for what in evidence.missing:
            print(f"warning: missing in the report: {what}")
    write_report(record, out, evidence)
    print(f"{out}: {out.stat().st_size / 1e3:,.0f} kB")
    return out


if __name__ == "__main__":
    main(tyro.cli(Report, description=__doc__))
