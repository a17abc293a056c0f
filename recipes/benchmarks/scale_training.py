"""Training speed of one and of several processes::

    python recipes/benchmarks/scale_training.py --num-threads 1
    torchrun --nproc-per-node 2 recipes/benchmarks/scale_training.py --num-threads 1

Updates of the world model, and imagination and updates of LOOP, on the same global batch, however many processes share
it: per second of the clock, and per core-second of all processes. And what the gradients are worth in bytes, counted as
``DistributedDataParallel`` hands them over. The models are untrained: nothing is learned and nothing is kept.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

import torch
import tyro
from torch.distributed.algorithms.ddp_comm_hooks.default_hooks import allreduce_hook

import processes
from command_line import at_least, refusals
from config import WorldEnvConfig
from data_parallel import DataParallel
from imagination import Imagination
from parts import COMPACT
from physics import exploring_actor, tabletop
from run import Run
from run_folder import RunFolder
from speeds import Speed, core_seconds, speed
from threads import use_threads
from updates import update
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import episodes_from_rollouts, window_buffer
from worldenv_trl.devices import choose_device, to_device
from worldenv_trl.envs import ExpertPolicy
from worldenv_trl.objectives import LOOPLoss, WorldModelLoss, rloo_advantage
from worldenv_trl.reflectors import StopRule


@dataclass(frozen=True)
class Settings:
    """What is measured, and how often."""

    device: str = "auto"
    """Of the models: ``cpu``, ``cuda``, or ``auto``, CUDA where there is one."""
    num_threads: int = 1
    """Of each process."""
    repeats: int = 3
    batch_size: int = 8
    """Windows of an update of the world model, of all processes."""
    groups: int = 24
    """Of an iteration of LOOP, of all processes, ..."""
    group_size: int = 8
    """... and rollouts of each."""


def main(settings: Settings) -> None:
    with refusals():
        device = choose_device(processes.join(settings.device))
        use_threads(settings.num_threads)
        at_least(1, repeats=settings.repeats, batch_size=settings.batch_size, groups=settings.groups)
        at_least(2, group_size=settings.group_size)
        for name in ("batch_size", "groups"):
            if getattr(settings, name) % processes.size():
                said = f"--{name.replace('_', '-')} must be a multiple of the {processes.size()} processes"
                raise ValueError(f"{said}, got {getattr(settings, name)}")
    torch.manual_seed(0)
    config = WorldEnvConfig(num_threads=settings.num_threads, device=settings.device)
    run = Run(config, RunFolder(config.run_dir))
    print(f"{processes.size()} process(es) on {device.type}, {settings.num_threads} thread(s) each")
    env = tabletop(config, "train", 15, None, init_state_mode="cycle")
    demonstrations = next(iter(GroupCollector(env, ExpertPolicy(env), groups_per_batch=15)))[:, 0]
    env.close()

    model = COMPACT.world_model.make(config).to(device)
    rows = settings.batch_size // processes.size()
    windows = window_buffer(episodes_from_rollouts(demonstrations), run.kinematics, model, batch_size=rows, seed=0)
    learner, sent = _counted(DataParallel(model.train(), WorldModelLoss))

    def train() -> float:
        for _ in range(3):
            with processes.sharing():
                out = learner(windows.sample())
            model.zero_grad()
            learner.backward_mean(out["loss_world_model"], out["weight"])
        return 3.0

    _line(f"world model, batch {settings.batch_size}, updates", _speed(train, settings, device))
    _bytes(sent, 3 * (settings.repeats + 1))
    learner.close()
    _loop(settings, run, Imagination(
        model.eval(),
        COMPACT.reflector.make(config).to(device).eval(),
        StopRule(0.999),
        to_device(demonstrations[:, 0], device),
    ))  # fmt: skip


def _loop(settings: Settings, run: Run, imagination: Imagination) -> None:
    # The policy is untrained: it may move far. One epoch tells as much as four.
    learned = dataclasses.replace(run.config.post_train, max_kl=math.inf, epochs=1)
    policy = COMPACT.policy.make(run.config).to(run.device)
    groups = policy.post_training_parameters(learned.lora_rank)
    actor = exploring_actor(run.config, policy, learned.scale_factor, learned.noise)
    mine = settings.groups // processes.size()
    env = imagination.env(run, [mine, settings.group_size], seed=0)
    collector = GroupCollector(env, actor, groups_per_batch=mine)
    collector.exclude = [("next", "observation")]
    learner, sent = _counted(DataParallel(policy, lambda part: LOOPLoss(actor, functional=False)))
    optimizer = torch.optim.AdamW([{"params": group} for group in groups.values()], lr=1e-6, weight_decay=0.0)
    waves: list[Any] = []
    updates: list[float] = []

    def imagine() -> float:
        with processes.sharing():
            waves[:] = [collector.next()]
        (wave,) = waves
        return float(processes.total((wave["next", keys.STEP_MASK] & wave[keys.MASK][..., None]).sum()))

    def learn() -> float:
        (wave,) = waves
        advantage = processes.own_rows_of(rloo_advantage(processes.gathered(wave["returns"][..., 0])))
        wave[keys.ADVANTAGE] = advantage[..., None, None].expand(*wave.shape, 1)
        updates.append(update(wave, policy.in_keys, learner, optimizer, list(groups.values()), learned)["updates"])
        return updates[-1]

    rows = settings.groups * settings.group_size
    imagined = _speed(imagine, settings, run.device)
    _line(f"imagination, {rows} rollouts, frames", imagined)
    updated = _speed(learn, settings, run.device)
    _line(f"LOOP, minibatch {learned.minibatch_size}, updates", updated)
    _bytes(sent, sum(updates))
    collector.shutdown()


def _speed(work: Callable[[], float], settings: Settings, device: torch.device) -> Speed:
    """Of what all processes do together: in seconds of the clock, and in core-seconds of all."""
    processes.barrier()
    busy = core_seconds()
    measured = speed(work, settings.repeats, device)
    busy = core_seconds() - busy
    share = busy / sum(processes.gathered_values(busy))
    return Speed(measured.per_second, tuple(share * each for each in measured.per_core_second))


def _counted(learner: DataParallel) -> tuple[DataParallel, list[int]]:
    """The bytes of every bucket of gradients that it hands to the all-reduce, as they come."""
    sent: list[int] = []

    def note(bucket: Any) -> Any:
        sent.append(bucket.buffer().nbytes)
        return bucket

    learner.on_exchange(lambda _, bucket: allreduce_hook(None, note(bucket)))  # a lambda: annotations are checked
    return learner, sent


def _line(name: str, measured: Speed) -> None:
    low, high = min(measured.per_second), max(measured.per_second)
    print(
        f"{name:<44}{measured.wall:>10.4g} a second [{low:.4g}, {high:.4g}]{measured.core:>10.4g} a core-second",
        flush=True,
    )


def _bytes(sent: list[int], updates: float) -> None:
    print(f"  {sum(sent) / max(updates, 1) / 2**20:.3g} MiB of gradients all-reduced for an update", flush=True)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The name target_actor_network_params")
        main(tyro.cli(Settings, description=__doc__))
