"""``python recipes/world_env.py PRESET ... --dry-run``: what a run would take, without running it.

Parts at real size are built on the meta device, from the files of the folders that are named, of published sizes where
none is; one decision passes through them from end to end. No run folder is touched.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from beginning import beginning
from checks import check_config, doubts
from command_line import expected, in_options
from config import WorldEnvConfig
from gpus import GPUS
from libero_files import told
from parts import COMPACT, Parts
from real_parts import parts_of
from rehearsal import Rehearsal, rehearse
from run_folder import RunFolder
from stage_plan import Machine, StagePlan, decisions, iteration_flops, moved_bytes, stage_plans, wave_bytes
from stages import plan
from task_names import with_tasks
from worldenv_trl.devices import check_device_name

_HERE = "here"
_TITLES = {"policy": "policy", "world_model": "world model", "reflector": "reflector"}
_UNITS = (("P", 1e15), ("T", 1e12), ("G", 1e9), ("M", 1e6))
_SMALLER = {
    "sft": "--sft.batch-size, --post-train.lora-rank",
    "explore": "--explore.num-envs",
    "train_world_model": "--world-model.batch-size, --real-size.frame-size",
    "train_reflector": "--real-size.rows-per-call, --real-size.num-frames",
    "adapt": "--adapt.batch-size, --post-train.lora-rank, --real-size.rows-per-call",
    "post_train": "--post-train.minibatch-size, --post-train.groups, --post-train.lora-rank, --real-size.rows-per-call",
    "evaluate": "--evaluate.num-envs",
}


def options() -> argparse.ArgumentParser:
    """Those of the dry run, which stand anywhere among the settings."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--dry-run", action="store_true")
    parser.add_argument("--gpus", type=int)
    parser.add_argument("--gpu", choices=[_HERE, *(gpu.name for gpu in GPUS)])
    parser.add_argument("--matmul-share", type=float, default=0.3)
    return parser


def split(arguments: Sequence[str]) -> tuple[argparse.Namespace | None, list[str]]:
    """The dry run's options, None where it is not asked for, and the settings."""
    chosen, rest = options().parse_known_args(list(arguments))
    return (chosen, rest) if chosen.dry_run else (None, list(arguments))


def dry_run(config: WorldEnvConfig, chosen: argparse.Namespace, parts: Parts | None = None) -> int:
    """Prints the plan and, a line each, what does not fit; returns how many lines these are."""
    try:
        config = with_tasks(config)
        parts = parts_of(config) if parts is None else parts
        machine = _machine(config, chosen)
        check_device_name(config.device)
        # Whether this machine has the run's device says nothing of another one; the parts are built below.
        bare = replace(parts, **{name: replace(getattr(parts, name), outline=None) for name in _TITLES})
        check_config(replace(config, device="cpu"), bare)
        folder = RunFolder(config.run_dir)
        folder.check_settings(config)
        begun = beginning(config, plan(config), folder)
    except Exception as error:
        if not expected(error):
            raise
        return _refused([in_options(error)])
    published = _published(config) if parts is parts_of(config) else {}
    found = rehearse(config, parts, published)
    for name in published:
        print(f"{_TITLES[name]}: no folder named (--real-size.{name.replace('_', '-')}), of published sizes")
    finished = [stage.name for stage in plan(config) if stage.finished_in(folder)]
    here = [f"{', '.join(finished)}: finished in {folder.path}"] if finished else []
    for line in (*told(config), *found.shapes, *([str(begun)] if begun else here)):
        print(line)
    for doubt in doubts(config):
        print(f"warning: {doubt}")
    if found.problems:
        return _refused(found.problems)
    _show_parts(found)
    taken = {stage.name for stage in begun.stages} if begun else set(finished)
    plans = [stage for stage in stage_plans(config, found, machine) if stage.name not in taken]
    _show_stages(plans, machine)
    _show_iteration(config, found, machine)
    for stage in plans:
        if stage.sharded_bytes <= machine.memory < stage.whole_bytes:
            print(
                f"note: {stage.name} fits a {machine.name} sharded alone; --parallel fsdp shards what is trained, and "
                "a whole copy of it stays in every process to act with"
            )
    return _refused(too_large(plans, machine))


def too_large(plans: Sequence[StagePlan], machine: Machine) -> list[str]:
    """A line for each stage that a GPU's memory does not hold, with the settings that help."""
    lines = []
    for stage in plans:
        needed = min(stage.whole_bytes, stage.sharded_bytes)
        if needed > machine.memory:
            how = f"sharded over {machine.gpus} GPUs" if machine.gpus > 1 else "on one GPU"
            lines.append(
                f"{stage.name} takes {_bytes(needed)} {how}, a {machine.name} has {_bytes(machine.memory)}: "
                f"less of {_SMALLER[stage.kind]}, or more --gpus"
            )
    return lines


def _machine(config: WorldEnvConfig, chosen: argparse.Namespace) -> Machine:
    real = config.parts == "real-size"
    count = chosen.gpus if chosen.gpus is not None else (8 if real else 1)
    if count < 1:
        raise ValueError(f"--gpus must be at least 1, got {count}")
    if not 0 < chosen.matmul_share <= 1:
        raise ValueError(f"--matmul-share must lie above 0 and at most at 1, got {chosen.matmul_share}")
    named = chosen.gpu or ("H100" if real else _HERE)
    if named == _HERE:
        from speeds import matmul_bound

        rate = matmul_bound(torch.device("cpu"), torch.float32, 3).wall
        memory = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
        return Machine("processor of this machine", "cpu", count, rate, memory, chosen.matmul_share)
    gpu = next(each for each in GPUS if each.name == named)
    return Machine(gpu.name, "cuda", count, gpu.bf16_flops, gpu.memory, chosen.matmul_share)


def _published(config: WorldEnvConfig) -> dict[str, Callable]:
    if parts_of(config) is COMPACT:
        return {}
    from published_sizes import PUBLISHED  # transformers takes seconds

    return {name: build for name, build in PUBLISHED.items() if getattr(config.real_size, name) is None}


def _show_parts(found: Rehearsal) -> None:
    print("\nparts                parameters      learning    weights  gradients  optimiser")
    for name, title in _TITLES.items():
        part = found.sizes[name]
        print(
            f"{title:<18}{part.parameters / 1e6:>11,.1f} M {part.trainable / 1e6:>11,.1f} M "
            f"{_bytes(part.weight_bytes):>10} {_bytes(part.gradient_bytes):>10} {_bytes(part.optimizer_bytes):>10}"
        )
    works = {
        "decide": "a decision",
        "update": "an update's decision",
        "imagine": "an imagined chunk",
        "dream": "a learned chunk",
        "see": "a frame seen",
        "judge": "a judgement",
    }
    print()
    for name, title in works.items():
        call = found.calls.get(name)
        if call is not None and call.flops:
            print(f"{title:<22}{_flops(call.flops):>14}, activations {_bytes(call.activation_bytes)}")


def _show_stages(plans: Sequence[StagePlan], machine: Machine) -> None:
    each = f"{_flops(machine.flops)}/s and {_bytes(machine.memory)} each"
    print(f"\nat most, on {machine.gpus} x {machine.name} ({each}) at {machine.share:.0%} of the matmul bound;")
    print("memory of one, with parts whole or sharded (FSDP):")
    print(f"{'stage':<16}{'operations':>16}{'time':>12}{'activations':>13}{'whole':>11}{'sharded':>11}")
    for stage in plans:
        shown = _time(machine.seconds(stage.flops)) + ("*" if stage.physics else " ")
        print(
            f"{stage.name:<16}{_flops(stage.flops):>16}{shown:>12}{_bytes(stage.activation_bytes):>13}"
            f"{_bytes(stage.whole_bytes):>11}{_bytes(stage.sharded_bytes):>11}"
        )
    total = sum(stage.flops for stage in plans)
    print(f"{'all':<16}{_flops(total):>16}{_time(machine.seconds(total)):>11} \n* and the physics, on the processor")


def _show_iteration(config: WorldEnvConfig, found: Rehearsal, machine: Machine) -> None:
    settings, moved = config.post_train, moved_bytes(config, found, machine)
    taken = _time(machine.seconds(iteration_flops(config, found)))
    print(
        f"an iteration of LOOP: {settings.groups} x {settings.group_size} rollouts of {decisions(config)} decisions, "
        f"{taken}; a GPU sends {_bytes(moved['whole'])} with parts whole, {_bytes(moved['sharded'])} sharded; images "
        f"kept until its updates {_bytes(wave_bytes(config))}"
    )


def _refused(problems: Sequence[str]) -> int:
    for line in problems:
        print(f"error: {line}")
    return len(problems)


def _bytes(size: float) -> str:
    return f"{size / 1e9:,.1f} GB" if size >= 1e9 else f"{size / 1e6:,.1f} MB"


def _flops(count: float) -> str:
    return next((f"{count / scale:,.1f} {unit}FLOP" for unit, scale in _UNITS if count >= scale), f"{count:.0f} FLOP")


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:,.1f} s"
    return f"{seconds / 60:,.1f} min" if seconds < 7200 else f"{seconds / 3600:,.1f} h"
