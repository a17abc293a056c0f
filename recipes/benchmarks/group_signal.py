"""How much truth an imagined return holds inside a LOOP group.

``python recipes/benchmarks/group_signal.py runs/improve``. Once: groups of rollouts of a policy in the physics, sampled
as LOOP samples them, kept in ``RUN/signal/POLICY``. Then, for any world model and reflector, the same actions are
imagined and the returns held against what the physics knows. Per task and over all, with 95 % intervals from a
bootstrap over groups:

- r: correlation of return and real success inside a group, mean over the groups in which some rollouts succeed and some
  fail; 0 where all returns of a group are equal. The return is R where the stop rule ends the rollout, or at the step
  limit; "r stop" has stopped or not instead, "r largest" the largest R of the whole video. Success is whether the
  physics reaches the goal within the step limit. "slope in groups": real success that a unit of return is worth there.
- kappa, precision and recall of stops. A stop is right if the goal has been reached by then, in imagination up to two
  frames later (``metrics.judged``).
- ECE (expected calibration error, ten bins) and slope of the return against the goal being reached by the end.

Rows: the reflector on the real frames (its ceiling); one chunk ahead (real frames as memory at the start of every
chunk); imagination; with ``--dreamt`` also other groups, from the same initial states, that the policy dreamt: what it
does when it looks at imagined frames, as in LOOP, judged there and then lived in the physics (kept, too). The last
table is r when real frames are shown to the first chunks only: when the truth is lost. A judge that looks at no video
(``reflector.path_epochs``) has no need of either: "imagined" is then what it says.
"""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from command_line import at_least, refusals, writable
from dreamt_groups import dreamt_groups
from gather_evidence import read_config
from group_views import (
    AHEAD,
    DREAMT,
    FIGURES,
    IMAGINED,
    RuledReflector,
    curve,
    figures,
    mean_correlation,
    view,
    views,
)
from real_groups import Draw, RealGroups, check_draw, real_groups
from run import Run, read_rules
from run_folder import RunFolder
from threads import use_threads
from worldenv_trl.metrics import Estimate
from worldenv_trl.record.mcap.provenance import model_hash
from worldenv_trl.report import RunRecord
from worldenv_trl.world_models import WorldModel


@dataclass(frozen=True)
class Settings:
    run: tyro.conf.Positional[Path]
    """Run folder of recipes/world_env.py: its tasks, training initial states and checkpoints."""
    policy: str = "sft"
    """Checkpoint of the run, or folder of one, that the groups are drawn with."""
    world_model: str = "world_model"
    """Checkpoint of the run, or folder of one."""
    reflector: str = "reflector"
    """Checkpoint of the run, or folder of one, with its stop rules."""
    contexts: int = 48
    """Training initial states, as many of each task."""
    group_size: int = 8
    """Rollouts from each."""
    scale_factor: float | None = None
    """Multiple of the policy's scale that is sampled with; the run's post_train.scale_factor if not given."""
    seed: int = 0
    """Of the samples."""
    groups: Path | None = None
    """Folder of the groups, RUN/signal/POLICY if not given. Groups that are there are read, not drawn again."""
    overwrite: bool = False
    """Draw the groups again, and dream again."""
    dreamt: bool = False
    """What the policy does in imagination, too: for each world model about as long again, once, as the groups in the
    physics took."""
    shown_chunks: tuple[int, ...] = (2, 4, 6)
    """Numbers of chunks, at least 2, up to which real frames are shown; 1 and all are always there. Each number is up
    to another imagination of the mixed groups."""
    against: Path | None = None
    """JSON that other models left for the same groups: the difference of r, group by group, is shown, too."""
    resamples: int = 1000
    """Of the bootstrap."""
    out: Path | None = None
    """JSON of all figures; WORLD_MODEL-REFLECTOR.json beside the groups if not given, with the beginning of their
    hashes where they are not the run's."""
    num_threads: int = 1
    device: str = "auto"
    """Of the models: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one."""


def main(settings: Settings) -> Path:
    with refusals():
        at_least(1, resamples=settings.resamples)
        at_least(2, shown_chunks=settings.shown_chunks or (2,))
        use_threads(settings.num_threads)
        config = read_config(RunRecord.read(settings.run), settings.num_threads, settings.device)
        run = Run(config, RunFolder(settings.run))
        factor = config.post_train.scale_factor if settings.scale_factor is None else settings.scale_factor
        draw = Draw(settings.contexts, settings.group_size, factor, config.post_train.noise, settings.seed)
        check_draw(run, draw)
        paths = {
            "policy": run.folder.named_checkpoint(settings.policy, "sft"),
            "world_model": run.folder.named_checkpoint(settings.world_model, "train_world_model"),
            "reflector": run.folder.named_checkpoint(settings.reflector, "train_reflector"),
        }
        policy = run.parts.policy.load(paths["policy"]).to(run.device)
        world_model = run.parts.world_model.load(paths["world_model"]).eval().to(run.device)
        reflector = run.parts.reflector.load(paths["reflector"]).eval().to(run.device)
        judge = RuledReflector(reflector, read_rules(paths["reflector"]))
        before = None if settings.against is None else read_report(settings.against)
        folder = settings.groups or settings.run / "signal" / paths["policy"].name
        models = {"policy": policy, "world_model": world_model, "reflector": judge.reflector}
        hashes = {name: model_hash(model) for name, model in models.items()}
        names = [
            path.name if path.parent == run.folder.path / "checkpoints" else f"{path.name}_{hashes[name][:8]}"
            for name, path in paths.items()
        ]
        out = writable(settings.out or folder / f"{'-'.join(names[1:])}.json")
        groups = real_groups(run, policy, draw, folder, settings.overwrite)
        groups.episodes.require("the world model", world_model.cameras, world_model.image_size)
        groups.episodes.require("the reflector", judge.reflector.cameras, judge.reflector.image_size)
        report = {
            "draw": asdict(draw),
            "models": {name: {"path": str(path), "hash": hashes[name]} for name, path in paths.items()},
            "rules": {name: asdict(rule) for name, rule in judge.rules.items()},
            "context_id": groups.context_id.tolist(),
        }
        if before is not None:
            _check_comparable(report, before, settings.against)
        dreams = None
        if settings.dreamt:
            dreams = dreamt_groups(
                run, policy, world_model, groups, draw, folder / f"dreams-{names[1]}", settings.overwrite
            )
    report |= measure(run, groups, world_model, judge, settings, before, dreams)
    out.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    print(markdown(report))
    print(f"\n{out}: all figures; measured in {report['seconds']:.0f} s")
    return out


def read_report(path: Path) -> dict[str, Any]:
    """What :func:`main` wrote.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is something else.
    """
    try:
        report = json.loads(path.read_text())
        _ = report["models"]["policy"]["hash"], report["draw"], report["context_id"], report["correlations"][IMAGINED]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} holds no figures of group_signal.py ({error!r})") from error
    return report


def _check_comparable(report: dict[str, Any], before: dict[str, Any], path: Path | None) -> None:
    ours, theirs = ((each["draw"], each["context_id"], each["models"]["policy"]["hash"]) for each in (report, before))
    if ours != theirs:
        raise ValueError(f"{path} is of other groups: measure both with the same policy, contexts and seed")


def measure(
    run: Run,
    groups: RealGroups,
    world_model: WorldModel,
    judge: RuledReflector,
    settings: Settings,
    before: dict[str, Any] | None = None,
    dreams: RealGroups | None = None,
) -> dict[str, Any]:
    """All figures as plain values, by view, task and name: ``[value, low, high]``, None where one cannot be said.

    ``before``: a report of the same groups to compare with. ``dreams``: groups of the same contexts, dreamt.
    """
    started = time.monotonic()
    seen, ahead = views(judge, world_model, run.kinematics, groups)
    if dreams is not None:
        seen[DREAMT] = view(judge, dreams, dreams.episodes)
    chunks = math.ceil(groups.episodes["actions"].shape[1] / world_model.chunk_length)
    between = tuple(sorted({shown for shown in settings.shown_chunks if shown < chunks}))
    shown_to = {1: seen[IMAGINED].correlations}
    if ahead is not None:
        shown_to |= curve(judge, world_model, run.kinematics, groups, (seen[AHEAD], ahead), between)
        shown_to[chunks] = seen[AHEAD].correlations
    numbers, kinds = groups.task_id, {"all": torch.ones_like(groups.task_id, dtype=torch.bool)}
    kinds |= {task: numbers == place for place, task in enumerate(run.config.tasks)}

    def mean(values: Tensor, rows: Tensor) -> list[float | None]:
        return _plain(mean_correlation(values, numbers, rows, settings.resamples))

    report: dict[str, Any] = {
        "groups": {
            task: {
                "groups": int(rows.sum()),
                "mixed": int(groups.mixed[rows].sum()),
                "success": groups.success[rows].float().mean().item(),
                **({} if dreams is None else {"dreamt_success": dreams.success[rows].float().mean().item()}),
            }
            for task, rows in kinds.items()
        },
        "views": {
            name: {
                task: {
                    figure: _plain(each) for figure, each in figures(view, numbers, rows, settings.resamples).items()
                }
                for task, rows in kinds.items()
            }
            for name, view in seen.items()
        },
        "curve": {
            task: {str(shown): mean(values, rows) for shown, values in shown_to.items()} for task, rows in kinds.items()
        },
        "correlations": {
            name: [None if math.isnan(r) else r for r in view.correlations.tolist()] for name, view in seen.items()
        },
    }
    if before is not None:
        other = torch.tensor([math.nan if r is None else r for r in before["correlations"][IMAGINED]])
        gain = seen[IMAGINED].correlations - other
        report["gain"] = {task: mean(gain, rows) for task, rows in kinds.items()}
    return report | {"seconds": time.monotonic() - started}


def _plain(estimate: Estimate) -> list[float | None]:
    return [None if math.isnan(value) else value for value in (estimate.value, estimate.low, estimate.high)]


def markdown(report: dict[str, Any]) -> str:
    """The tables of a report."""
    dreamt = {task: each["dreamt_success"] for task, each in report["groups"].items() if "dreamt_success" in each}
    lines = [f"| task | groups | mixed | real success |{' of actions dreamt |' if dreamt else ''}"]
    lines += ["|---|---|---|---|" + "---|" * bool(dreamt)]
    lines += [
        f"| {_short(task)} | {each['groups']} | {each['mixed']} | {each['success']:.2f} |"
        + (f" {dreamt[task]:.2f} |" if dreamt else "")
        for task, each in report["groups"].items()
    ]
    names = [name.replace("_", " ") for name in FIGURES]
    lines += ["", f"| seen | task | {' | '.join(names)} |", "|" + "---|" * (len(names) + 2)]
    lines += [
        f"| {seen} | {_short(task)} | {' | '.join(_cell(each[name]) for name in FIGURES)} |"
        for seen, by_task in report["views"].items()
        for task, each in by_task.items()
    ]
    shown = list(report["curve"]["all"])
    lines += ["", f"| r, real frames shown to chunks | {' | '.join(['1', *(f'1-{last}' for last in shown[1:])])} |"]
    lines += ["|" + "---|" * (len(shown) + 1)]
    lines += [
        f"| {_short(task)} | {' | '.join(_cell(each[last]) for last in shown)} |"
        for task, each in report["curve"].items()
    ]
    if "gain" in report:
        lines += ["", "| r imagined, more than before |  |", "|---|---|"]
        lines += [f"| {_short(task)} | {_cell(each, '+.2f')} |" for task, each in report["gain"].items()]
    return "\n".join(lines)


def _short(task: str) -> str:
    return task.split("/")[-1].replace("_", " ")


def _cell(estimate: list[float | None], form: str = ".2f") -> str:
    value, low, high = ("-" if each is None else format(each, form) for each in estimate)
    return value if value == "-" else f"{value} [{low}, {high}]"


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
