"""What a report shows of a run's models: its policies on held-out initial states, in the physics and in imagination."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from config import WorldEnvConfig
from parts import Parts, instructions
from real_parts import parts_of
from run import Run
from run_folder import RunFolder
from two_worlds import TwoWorlds, honesty_of, imagine, live, relive
from worldenv_trl import keys
from worldenv_trl.data import Episodes, episodes_from_rollouts
from worldenv_trl.data.episodes import concatenated
from worldenv_trl.devices import choose_device
from worldenv_trl.hdf5_file import SUFFIXES
from worldenv_trl.metrics import advantage_correlation, first_success, honesty, judged, moving_pixel_psnr
from worldenv_trl.policies import policy_actor
from worldenv_trl.record import read_rollouts
from worldenv_trl.record.mcap.recording import Recording
from worldenv_trl.reflectors import Reflector, StopRule
from worldenv_trl.report import Clip, Evidence, RunRecord, choose_clips, count_kinds
from worldenv_trl.scenes import load_task
from worldenv_trl.world_models import WorldModel

_AT_ONCE = 16  # rollouts in memory while a wave is read


def gather(
    record: RunRecord,
    episodes_per_task: int,
    clips_per_kind: int,
    num_threads: int,
    parts: Parts | None = None,
    device: str = "auto",
) -> Evidence:
    """Everything that needs the run's models; what cannot be had is named in ``missing``.

    Raises:
        FileNotFoundError: for a checkpoint that is missing, naming the stage that makes it.
        ValueError: for tasks that this release does not have, or whose instructions the models were not trained on; for
            a device that does not exist.
    """
    config = read_config(record, num_threads, device)
    run = Run(config, RunFolder(record.path), parts_of(config) if parts is None else parts)
    models = [path.name for path in sorted((record.path / "checkpoints").glob("reflector*")) if path.is_dir()]
    suffix = models[-1].removeprefix("reflector") if models else ""
    world_model, reflector, rules = run.world_model(suffix), run.reflector(suffix), run.rules(suffix)
    _check_tasks(record, config, world_model, reflector)
    policies = [name for name in ("sft", f"post_train{suffix}") if run.folder.checkpoint(name).is_dir()]
    if not policies:
        raise FileNotFoundError("there is no checkpoint of a policy: run the stage 'sft' first")
    missing = [] if len(policies) == 2 else ["the stage post_train has not finished: the policy before it is shown"]
    worlds: dict[str, TwoWorlds] = {}
    for name in policies:
        actor = policy_actor(run.policy(name).eval())
        print(f"{name}: {episodes_per_task} held-out episodes a task, in the physics and in imagination")
        worlds[name] = imagine(run, world_model, reflector, rules, live(run, actor, range(episodes_per_task)))
    waves = []
    for path in _waves(record, suffix):
        try:
            waves += _relived(run, path)
        except ValueError as error:
            missing.append(f"the wave {path.name} cannot be replayed: {short(error)}")
    shown = [clip for name in reversed(policies) for clip in clips(worlds[name], name, config, rules["imagined"])]
    return Evidence(
        clips=choose_clips(shown, clips_per_kind),
        counts={name: count_kinds(shown, name) for name in policies},
        honesty=[row for name in policies for row in _honesty_rows(worlds[name], name, config)],
        waves=waves,
        drift={name: honesty_of(worlds[name])["drift"] for name in policies},
        scores=_frame_scores(list(worlds.values())),
        rules={name: (rule.threshold, rule.consecutive) for name, rule in rules.items()},
        episodes=len(worlds[policies[-1]].episodes),
        missing=missing,
        notes=[
            f"Film strips, drift, calibration and confusion: the first {episodes_per_task} held-out initial "
            "states of each task, greedy, to the step limit in the physics; the same actions imagined open loop.",
            "Imagination's verdict is the reflector's stopping rule on imagined frames; the physics' is its goal.",
            "Imagination parts from the physics where the mean colour of a patch, an eighth of the image wide, is off "
            "by more than 40 of 255 for three steps in a row.",
        ],
    )


def _check_tasks(record: RunRecord, config: WorldEnvConfig, world_model: WorldModel, reflector: Reflector) -> None:
    """The models must have been trained on what the tasks of this release ask for."""
    for part in (world_model, reflector):
        if part.instructions and (strange := sorted(set(instructions(config)) - set(part.instructions))):
            raise ValueError(
                f"the models of this run do not know {', '.join(map(repr, strange))}: the tasks have changed since. "
                f"{_remedy(record)}"
            )


def _remedy(record: RunRecord) -> str:
    made = record.run_versions[0].get("worldenv_trl") if record.run_versions else None
    return f"Write the report with the release that made the run{f' ({made})' if made else ''}, or pass --no-models"


def read_config(record: RunRecord, num_threads: int, device: str = "auto") -> WorldEnvConfig:
    """The run's settings but for what this machine decides; one that this release does not know is left out.

    Raises:
        FileNotFoundError: naming a task file that is not found from here.
        ValueError: naming a task that this release does not have, or a device that does not exist.
    """
    choose_device(device)
    here = {"run_dir": record.path, "num_threads": num_threads, "device": device}
    config = dataclasses.replace(_filled(WorldEnvConfig(), record.config), **here)
    for task in config.tasks:
        try:
            load_task(task)
        except (ValueError, OSError) as error:
            if task.endswith((".bddl", *SUFFIXES)) and not Path(task).exists():
                raise FileNotFoundError(
                    f"there is no task file {Path(task).resolve()}: the run was made with {task!r}; call this from the "
                    "folder that it was made from, or put the file there"
                ) from error
            raise ValueError(
                f"the run's task {task!r} is not one of this release ({error}). {_remedy(record)}"
            ) from error
    return config


def _filled(settings: Any, values: dict[str, Any]) -> Any:
    known = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    found = {}
    for name, value in values.items():
        if name in known and dataclasses.is_dataclass(known[name]):
            found[name] = _filled(known[name], value)
        elif name in known:
            found[name] = tuple(value) if isinstance(value, list) else value
    return dataclasses.replace(settings, **found)


def clips(worlds: TwoWorlds, policy: str, config: WorldEnvConfig, rule: StopRule) -> list[Clip]:
    """Every episode of a policy, in both worlds, its cameras one above the other."""
    out = []
    for row in range(len(worlds.episodes)):
        steps = int(worlds.episodes["length"][row]) + 1
        real, imagined = (
            _film(each, row, steps, worlds.imagined.cameras) for each in (worlds.episodes, worlds.imagined)
        )
        psnr = moving_pixel_psnr(imagined, real, real[:1].expand_as(real)).clamp(max=60)
        out.append(
            Clip(
                task=config.tasks[int(worlds.episodes[keys.TASK_ID][row])].split("/")[-1].replace("_", " "),
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
                threshold=rule.threshold,
            )
        )
    return out


def _film(episodes: Episodes, row: int, steps: int, cameras: tuple[str, ...]) -> Tensor:
    """uint8 [steps, 3, V H, W]."""
    frame = torch.arange(steps)
    return torch.cat([episodes.frames(camera, torch.full_like(frame, row), frame) for camera in cameras], -2)


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


def _by_task(episodes: Episodes | TensorDictBase, config: WorldEnvConfig) -> list[tuple[str, torch.Tensor]]:
    number = episodes[keys.TASK_ID].squeeze(-1)
    rows = {task: number == place for place, task in enumerate(config.tasks)}
    return [("all", torch.ones_like(number, dtype=torch.bool)), *((t, r) for t, r in rows.items() if bool(r.any()))]


def _waves(record: RunRecord, suffix: str) -> list[Path]:
    """The logged waves of LOOP: the first and the last iteration."""
    return sorted((record.path / "rollouts").glob(f"post_train{suffix}_[0-9][0-9][0-9].mcap"))


def _relived(run: Run, path: Path) -> list[dict[str, Any]]:
    """Honesty of a wave of imagined rollouts, whose actions are executed in the physics."""
    config = run.config
    if config.post_train.env != "imagined":
        return []
    count = Recording(path).count()
    print(f"{path.name}: {count} imagined rollouts in the physics")
    entries, stops, returns = [], [], []
    for start in range(0, count, _AT_ONCE):  # their frames are not kept
        rollouts = read_rollouts(path, rollouts=slice(start, start + _AT_ONCE))
        entries.append(episodes_from_rollouts(rollouts).entries)
        stopped = (rollouts["next", "terminated"].squeeze(-1) & rollouts[keys.MASK]).any(-1)
        stops.append(torch.where(stopped, entries[-1]["length"].squeeze(-1), -1))
        returns.append(rollouts["returns"][:, 0])  # the same at every decision
    episodes, stop, returned = concatenated(entries), torch.cat(stops), torch.cat(returns)
    reached = first_success(relive(run, episodes))
    imagined, real = judged(stop, reached)
    rows = []
    for task, chosen in _by_task(episodes, config):
        figures = honesty(imagined[chosen], real[chosen], imagined_steps=stop[chosen], real_steps=reached[chosen])
        groups = (-1, config.post_train.group_size)  # a group's rollouts follow each other and are of one task
        figures["signal"], figures["mixed"] = advantage_correlation(
            returned[chosen].reshape(groups), real[chosen].reshape(groups)
        )
        rows.append({"iteration": int(path.stem.rsplit("_", 1)[1]), "task": task} | figures)
    return rows


def _frame_scores(worlds: list[TwoWorlds]) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """R and the truth of every frame after the first, of all policies."""
    out = {}
    for name in ("real", "imagined"):
        parts = []
        for each in worlds:
            alive = each.episodes.alive
            alive[:, 0] = False
            parts.append((getattr(each, f"{name}_scores")[alive], each.episodes["success"][alive]))
        out[name] = torch.cat([score for score, _ in parts]), torch.cat([label for _, label in parts])
    return out


def short(error: Exception) -> str:
    """The message without the folder's path."""
    return re.split(r"checkpoints/|rollouts/", str(error))[-1]
