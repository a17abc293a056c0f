"""Plays a recorded rollout again: the same, in another world model, or with something changed.

python recipes/replay.py runs/demo/rollouts/demonstrations.mcap --rollout 3
python recipes/replay.py runs/demo/rollouts/post_train_000.mcap --rollout 7 --from-step 40 --policy sft
python recipes/replay.py runs/demo/rollouts/explore.mcap --rollout 7 --edit "43-50 gripper=-1"
python recipes/replay.py runs/demo/rollouts/demonstrations.mcap --mode imagination --world-model world_model

What was played is written beside the file, the report is printed, and ``--json`` keeps it. Models are looked for among
the ``checkpoints`` of the run by the hash that was recorded.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from command_line import one_line_errors, writable
from parts import COMPACT, Kind, Part, Parts
from worldenv_trl.devices import choose_device
from worldenv_trl.policies import AutoregressiveActor, LaplaceActor, Policy, policy_actor, scale_bounds
from worldenv_trl.record import model_hash, parse_edit, read_metadata, replay
from worldenv_trl.record.replay.source import open_rollout

_NAMES = {"policy": ("sft", "adapted*", "post_train*"), "world_model": ("world_model*",), "reflector": ("reflector*",)}


@dataclass(frozen=True)
class Options:
    file: tyro.conf.Positional[Path]
    """A recording."""
    rollout: int = 0
    """Number of the rollout in the file."""
    from_step: int = 0
    """Env step to begin or to branch at."""
    mode: str | None = None
    """``physics`` or ``imagination``; as recorded if not given."""
    world_model: str | None = None
    """Checkpoint: a name in the run's checkpoints, or a folder. The recorded one if not given."""
    reflector: str | None = None
    """Checkpoint of the reflector that stops the replay, or ``recorded``."""
    policy: str | None = None
    """What-if: checkpoint of the policy that acts from ``from_step`` on."""
    seed: int | None = None
    """What-if: of the policy's samples (greedy without) and of the world model's noise."""
    threshold: float | None = None
    """What-if: the reflector's, from ``from_step`` on."""
    edit: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """What-if: actions to change, such as "43 gripper=-1" or "40-47 dz=0.5"; may be given several times."""
    target: Path | None = None
    """The new file; beside the old one if not given."""
    device: str | None = None
    """Of the models: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one. As recorded, if possible,
    when not given: another one rounds otherwise and draws other noise."""
    json: Path | None = None
    """Write the report there, too ("-" prints it instead of the words)."""
    overwrite: bool = False
    """Replace files that exist."""


@one_line_errors
def main(options: Options, parts: Parts = COMPACT) -> int:
    report_file = None if str(options.json) == "-" else options.json
    if report_file is not None and report_file.exists() and not options.overwrite:
        raise FileExistsError(f"{report_file} exists: pass --overwrite or another name")
    if options.threshold is not None and not 0 < options.threshold < 1:
        raise ValueError(f"--threshold must be in (0, 1), got {options.threshold}")
    metadata = read_metadata(options.file)
    device = choose_device(options.device or ("auto" if metadata.get("device", "cpu") != "cpu" else "cpu"))
    imagined = options.mode == "imagination" or (
        options.mode is None and open_rollout(options.file, options.rollout).imagined
    )
    reflector = options.reflector or ("recorded" if options.threshold is not None else None)
    policy = None
    if options.policy is not None:
        acting = _checkpoint(parts.policy, options.policy, options.file, metadata, "policy").to(device)
        policy = recorded_actor(acting, metadata)
    edits: dict[int, dict[int, float]] = {}
    for text in options.edit:
        for step, values in parse_edit(text).items():
            edits.setdefault(step, {}).update(values)
    world_model = None
    if imagined:
        found = _checkpoint(parts.world_model, options.world_model, options.file, metadata, "world_model")
        world_model = found.to(device)
    if report_file is not None:
        writable(report_file, option="--json")
    report = replay(
        options.file,
        options.rollout,
        mode=options.mode,
        world_model=world_model,
        reflector=None
        if reflector is None
        else _checkpoint(parts.reflector, reflector, options.file, metadata, "reflector").to(device),
        from_step=options.from_step,
        policy=policy,
        seed=options.seed,
        threshold=options.threshold,
        edits=edits,
        target=options.target,
        overwrite=options.overwrite,
    )
    words = json.dumps(report.to_json(), indent=2)
    print(words if str(options.json) == "-" else report)
    if report_file is not None:
        report_file.write_text(words + "\n")
    return 0


def recorded_actor(policy: Policy, metadata: Mapping[str, Any]) -> LaplaceActor | AutoregressiveActor:
    """The policy with the noise of exploration, or of LOOP, as the settings in a recording's ``metadata`` have it; with
    its own trained scale where there are none."""
    settings = metadata.get("config", {})
    if "scale_floor" not in settings:
        return policy_actor(policy)
    bounds = scale_bounds(policy, tuple(settings["scale_floor"]), share=settings["scale_share"])
    section = settings["explore" if metadata.get("stage", "").startswith("explore") else "post_train"]
    noise = section.get("noise", settings.get("noise", "step"))  # once it was one setting of both
    factor = settings["post_train"]["scale_factor"]
    return policy_actor(policy, scale_factor=factor, log_scale_bounds=bounds, noise=noise)


def _checkpoint(part: Part[Kind], name: str | None, file: Path, metadata: dict, kind: str) -> Kind:
    """A checkpoint by name or folder; without one, that of the run with the recorded hash, else the newest."""
    folder = file.resolve().parent.parent / "checkpoints"
    found = [path for pattern in _NAMES[kind] for path in folder.glob(pattern) if path.is_dir()]
    if name is not None and name != "recorded":
        named = folder / name if (folder / name).is_dir() else Path(name)
        if not named.is_dir():
            there = ", ".join(sorted(path.name for path in found)) or "none"
            raise FileNotFoundError(
                f"{name} is no folder and no {kind.replace('_', ' ')} of {folder}: there is {there}"
            )
        return part.load(named).eval()
    if not found:
        option = kind.replace("_", "-")
        raise FileNotFoundError(f"no {kind.replace('_', ' ')} in {folder}: name a checkpoint with --{option}")
    found.sort(key=lambda path: path.stat().st_mtime)
    recorded = metadata.get("models", {}).get(kind)
    models = {path: part.load(path).eval() for path in found}
    for model in models.values():
        if model_hash(model) == recorded:
            return model
    return models[found[-1]]  # the replay says that it is another one


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
