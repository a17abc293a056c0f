"""One self-contained HTML file that says what a run came to, and why its policy fails where it fails.

``python recipes/report.py runs/improve`` writes ``runs/improve/report.html``. Beside the logged figures it plays the
policies before and after on held-out initial states, in the physics and in imagination (about a minute on one core);
``--no-models`` leaves that out. What a run does not hold yet is named in the report.
"""

from __future__ import annotations

import dataclasses
import re
import webbrowser
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict

from config import WorldEnvConfig
from parts import load_policy, load_reflector, load_world_model
from run_folder import RunFolder
from two_worlds import TwoWorlds, first_success, honesty_of, imagine, judged, live, relive
from worldenv_trl import keys
from worldenv_trl.data import episodes_from_rollouts
from worldenv_trl.metrics import honesty, moving_pixel_psnr
from worldenv_trl.policies import laplace_actor
from worldenv_trl.record import read_rollouts
from worldenv_trl.report import Clip, Evidence, RunRecord, write_report
from worldenv_trl.scenes import load_task


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
    show: bool = False
    """Open the report in the browser."""


def main(settings: Report) -> Path:
    try:
        record = RunRecord.read(settings.run)
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {error}") from error
    out = settings.run / "report.html" if settings.out is None else settings.out
    if not out.parent.is_dir():
        raise SystemExit(f"error: the folder {out.parent} does not exist: make it, or choose another --out")
    if settings.episodes_per_task < 1 or settings.clips_per_kind < 0:
        raise SystemExit(
            "error: episodes-per-task must be at least 1 and clips-per-kind at least 0, "
            f"got {settings.episodes_per_task} and {settings.clips_per_kind}"
        )
    torch.set_num_threads(settings.num_threads)
    evidence = None
    if settings.models:
        try:
            evidence = gather(record, settings)
        except (OSError, ValueError, RuntimeError) as error:  # the logged figures are shown all the same
            evidence = Evidence(missing=[_short(error)])
        for what in evidence.missing:
            print(f"warning: missing in the report: {what}")
    write_report(record, out, evidence)
    print(f"{out}: {out.stat().st_size / 1e3:,.0f} kB")
    if settings.show:
        webbrowser.open(out.resolve().as_uri())
    return out


def gather(record: RunRecord, settings: Report) -> Evidence:
    """Everything that needs the run's models; what cannot be had is named in ``missing``."""
    folder, config = RunFolder(record.path), read_config(record, settings.num_threads)
    models = [path.name for path in sorted((record.path / "checkpoints").glob("reflector*")) if path.is_dir()]
    suffix = models[-1].removeprefix("reflector") if models else ""
    world_model, reflector = load_world_model(folder, suffix), load_reflector(folder, suffix)
    policies = [name for name in ("sft", f"post_train{suffix}") if folder.checkpoint(name).is_dir()]
    if not policies:
        raise FileNotFoundError("there is no checkpoint of a policy: run the stage 'sft' first")
    missing = [] if len(policies) == 2 else ["the stage post_train has not finished: the policy before it is shown"]
    worlds: dict[str, TwoWorlds] = {}
    for name in policies:
        print(f"{name}: {settings.episodes_per_task} held-out episodes a task, in the physics and in imagination")
        actor = laplace_actor(load_policy(folder, name, name).eval())
        worlds[name] = imagine(world_model, reflector, live(config, actor, settings.episodes_per_task))
    rules = reflector.config
    waves = []
    for path in _waves(record, suffix):
        try:
            waves += _relived(config, path)
        except ValueError as error:
            missing.append(f"the wave {path.name} cannot be replayed: {_short(error)}")
    shown = [clip for name in reversed(policies) for clip in clips(worlds[name], name, config, rules.threshold)]
    return Evidence(
        clips=_choose(shown, settings.clips_per_kind),
        counts={name: _counts(shown, name) for name in policies},
        honesty=[row for name in policies for row in _honesty_rows(worlds[name], name, config)],
        waves=waves,
        drift={name: honesty_of(worlds[name])["drift"] for name in policies},
        scores=_frame_scores(list(worlds.values())),
        rules={
            "real": (rules.real_threshold, rules.real_consecutive),
            "imagined": (rules.threshold, rules.consecutive),
        },
        episodes=len(worlds[policies[-1]].episodes),
        missing=missing,
        notes=[
            f"Film strips, drift, calibration and confusion: the first {settings.episodes_per_task} held-out initial "
            "states of each task, greedy, to the step limit in the physics; the same actions imagined open loop.",
            "Imagination's verdict is the reflector's stopping rule on imagined frames; the physics' is its goal.",
            "Imagination parts from the physics where the mean colour of a patch, an eighth of the image wide, is off "
            "by more than 40 of 255 for three steps in a row.",
        ],
    )


def read_config(record: RunRecord, num_threads: int) -> WorldEnvConfig:
    """The run's settings; one that this release does not know is left out."""
    return dataclasses.replace(_filled(WorldEnvConfig(), record.config), run_dir=record.path, num_threads=num_threads)


def _filled(settings: Any, values: dict[str, Any]) -> Any:
    known = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    found = {}
    for name, value in values.items():
        if name in known and dataclasses.is_dataclass(known[name]):
            found[name] = _filled(known[name], value)
        elif name in known:
            found[name] = tuple(value) if isinstance(value, list) else value
    return dataclasses.replace(settings, **found)


def clips(worlds: TwoWorlds, policy: str, config: WorldEnvConfig, threshold: float) -> list[Clip]:
    """Every episode of a policy, in both worlds."""
    names = {load_task(task).task_id: task for task in config.tasks}
    frames, out = worlds.episodes["frames"], []
    for row in range(len(worlds.episodes)):
        steps = int(worlds.episodes["length"][row]) + 1
        real, imagined = frames[row, :steps], worlds.imagined_frames[row, :steps]
        psnr = moving_pixel_psnr(imagined, real, real[:1].expand_as(real)).clamp(max=60)
        out.append(
            Clip(
                task=names[int(worlds.episodes[keys.TASK_ID][row])].split("/")[-1].replace("_", " "),
                policy=policy,
                context_id=int(worlds.episodes[keys.CONTEXT_ID][row]),
                real_frames=real,
                imagined_frames=imagined,
                real_scores=worlds.real_scores[row, :steps],
                imagined_scores=worlds.imagined_scores[row, :steps],
                gripper=worlds.episodes["states"][row, :steps, 6],
                moving_psnr=psnr,
                reached=int(worlds.reached[row]),
                imagined_stop=int(worlds.imagined_stop[row]),
                threshold=threshold,
            )
        )
    return out


def _counts(shown: list[Clip], policy: str) -> dict[str, dict[str, int]]:
    """How often each kind of episode occurs in each task."""
    found: dict[str, Counter[str]] = {}
    for clip in shown:
        if clip.policy == policy:
            found.setdefault(clip.task, Counter())[clip.kind] += 1
    return {task: dict(kinds) for task, kinds in found.items()}


def _choose(shown: list[Clip], count: int) -> list[Clip]:
    """``count`` clips of each kind: the later policy's first, tasks in turn."""
    chosen = []
    for kind in ("failure", "false stop", "missed stop", "success"):
        turn: Counter[tuple[str, str]] = Counter()
        ranked = []
        for place, clip in enumerate(clip for clip in shown if clip.kind == kind):
            turn[clip.policy, clip.task] += 1
            ranked.append((clip.policy != shown[0].policy, turn[clip.policy, clip.task], place, clip))
        chosen += [clip for *_, clip in sorted(ranked, key=lambda entry: entry[:3])[:count]]
    return chosen


def _honesty_rows(worlds: TwoWorlds, policy: str, config: WorldEnvConfig) -> list[dict[str, Any]]:
    imagined, real = worlds.outcomes()
    rows = []
    for task, chosen in _by_task(worlds.episodes, config):
        figures = honesty(
            imagined[chosen],
            real[chosen],
            imagined_steps=worlds.imagined_stop[chosen],
            real_steps=worlds.reached[chosen],
        )
        rows.append({"policy": policy, "task": task} | figures)
    return rows


def _by_task(episodes: TensorDict, config: WorldEnvConfig) -> list[tuple[str, torch.Tensor]]:
    number = episodes[keys.TASK_ID].squeeze(-1)
    rows = {task: number == load_task(task).task_id for task in config.tasks}
    return [("all", torch.ones_like(number, dtype=torch.bool)), *((t, r) for t, r in rows.items() if bool(r.any()))]


def _waves(record: RunRecord, suffix: str) -> list[Path]:
    """The logged waves of LOOP: the first and the last iteration."""
    return sorted((record.path / "rollouts").glob(f"post_train{suffix}_[0-9][0-9][0-9].mcap"))


def _relived(config: WorldEnvConfig, path: Path) -> list[dict[str, Any]]:
    """Honesty of a wave of imagined rollouts, whose actions are executed in the physics."""
    if config.post_train.env != "imagined":
        return []
    rollouts = read_rollouts(path)
    print(f"{path.name}: {rollouts.shape[:-1].numel()} imagined rollouts in the physics")
    episodes = episodes_from_rollouts(rollouts)
    stopped = (rollouts["next", "terminated"].squeeze(-1) & rollouts[keys.MASK]).any(-1).flatten()
    stop = torch.where(stopped, episodes["length"].squeeze(-1), -1)
    reached = first_success(relive(config, episodes))
    imagined, real = judged(stop, reached)
    rows = []
    for task, chosen in _by_task(episodes, config):
        figures = honesty(imagined[chosen], real[chosen], imagined_steps=stop[chosen], real_steps=reached[chosen])
        rows.append({"iteration": int(path.stem.rsplit("_", 1)[1]), "task": task} | figures)
    return rows


def _frame_scores(worlds: list[TwoWorlds]) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """R and the truth of every frame after the first, of all policies."""
    out = {}
    for name in ("real", "imagined"):
        parts = []
        for each in worlds:
            alive = torch.arange(each.real_scores.shape[1]) <= each.episodes["length"]
            alive[:, 0] = False
            parts.append((getattr(each, f"{name}_scores")[alive], each.episodes["success"][alive]))
        out[name] = torch.cat([score for score, _ in parts]), torch.cat([label for _, label in parts])
    return out


def _short(error: Exception) -> str:
    """The message without the folder's path."""
    return re.split(r"checkpoints/|rollouts/", str(error))[-1]


if __name__ == "__main__":
    main(tyro.cli(Report, description=__doc__))
