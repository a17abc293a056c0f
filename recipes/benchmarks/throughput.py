"""Speeds of every part on this machine: ``python recipes/benchmarks/throughput.py [--num-threads 2]``.

Prints one line a figure: median of repeated measurements and their range. Nothing is learned and nothing is kept.
"""

from __future__ import annotations

import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

import torch
import tyro
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from command_line import refusals
from config import WorldEnvConfig
from imagination import Imagination
from parts import COMPACT
from physics import physics_waves_env, tabletop
from run import Run
from run_folder import RunFolder
from threads import use_threads
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import episodes_from_rollouts, policy_samples, window_buffer
from worldenv_trl.envs import ExpertPolicy
from worldenv_trl.objectives import LOOPLoss, WorldModelLoss
from worldenv_trl.policies import laplace_actor
from worldenv_trl.record import RolloutWriter, read_rollouts
from worldenv_trl.reflectors import StopRule
from worldenv_trl.world_models import WorldModel


@dataclass(frozen=True)
class Benchmark:
    """What is measured, and how often."""

    num_threads: int = 2
    repeats: int = 3
    rows: tuple[int, ...] = (1, 16, 64)
    """Batch sizes of TabletopEnv."""


class _Timed(WorldModel):
    """A world model that adds up the seconds spent inside it."""

    def __init__(self, model: WorldModel) -> None:
        sizes = {"image_size": model.image_size, "chunk_length": model.chunk_length}
        super().__init__(cameras=model.cameras, instructions=model.seen.instructions, **sizes)
        self.model, self.seconds = model, 0.0

    def memory_indices(self, now: torch.Tensor) -> torch.Tensor:
        return self.model.memory_indices(now)

    def forward(self, tensordict: TensorDict) -> TensorDict:
        started = time.perf_counter()
        out = self.model(tensordict)
        self.seconds += time.perf_counter() - started
        return out


def report(name: str, unit: str, values: list[float]) -> None:
    print(f"{name:<52} {statistics.median(values):>9.1f} {unit}   [{min(values):.1f}, {max(values):.1f}]", flush=True)


def rate(work: Callable[[], float], repeats: int) -> list[float]:
    """Units per second of ``work``, which returns how many it did; once more before, uncounted."""
    work()
    rates = []
    for _ in range(repeats):
        started = time.perf_counter()
        done = work()
        rates.append(done / (time.perf_counter() - started))
    return rates


def main(settings: Benchmark) -> None:
    with refusals():
        use_threads(settings.num_threads)
    torch.manual_seed(0)
    config = WorldEnvConfig(num_threads=settings.num_threads)
    print(f"{settings.num_threads} threads, median of {settings.repeats} [range]")

    for rows in settings.rows:
        env = tabletop(config, "train", rows, config.tasks[:1], terminate_on_success=False)
        steps = max(20, 640 // rows)
        speeds = rate(
            lambda env=env, n=steps, r=rows: r * env.rollout(n, break_when_any_done=False).shape[1], settings.repeats
        )
        report(f"TabletopEnv, 64 px, 1 camera, {rows} rows", "env-steps/s", speeds)
        env.close()

    env = tabletop(config, "train", 15, None, init_state_mode="cycle")
    demonstrations = next(iter(GroupCollector(env, ExpertPolicy(env), groups_per_batch=15)))[:, 0]
    env.close()
    episodes = episodes_from_rollouts(demonstrations)
    run = Run(config, RunFolder(config.run_dir))
    policy, model, reflector = (part.make(config) for part in (COMPACT.policy, COMPACT.world_model, COMPACT.reflector))
    actor = laplace_actor(policy)
    timed = _Timed(model.eval())
    env = Imagination(timed, reflector, StopRule(0.99), demonstrations[:, 0]).env(run, [8, 8], seed=0)
    collector = GroupCollector(env, actor, groups_per_batch=8)
    total, shares = [], []
    for index in range(settings.repeats + 1):
        timed.seconds, started = 0.0, time.perf_counter()
        wave = collector.next()
        seconds = time.perf_counter() - started
        if index:  # the first is a warm-up
            total.append((wave["next", keys.STEP_MASK] & wave[keys.MASK][..., None]).sum().item() / seconds)
            shares.append(100 * (1 - timed.seconds / seconds))
    report("imagined rollouts (policy, reflector), 64 rows", "frames/s", total)
    report("  of that time outside the world model", "%", shares)

    def train(loss: Callable[[], torch.Tensor], count: int) -> float:
        for _ in range(count):
            loss().backward()
        return count

    samples = policy_samples(episodes)
    cloning = BCLoss(actor, loss_function="l1")
    cloning.set_keys(action=keys.CHUNK, pad_mask=keys.ACTION_IS_PAD)
    draw = lambda n: samples[torch.randint(len(samples), (n,))]  # noqa: E731
    report("SFT, batch 64", "steps/s", rate(lambda: train(lambda: cloning(draw(64))["loss_bc"], 5), settings.repeats))
    batch = config.world_model.batch_size
    windows = window_buffer(episodes, run.kinematics, model.train(), batch_size=batch)
    loss = WorldModelLoss(model)
    speeds = rate(lambda: train(lambda: loss(windows.sample())["loss_world_model"], 3), settings.repeats)
    report(f"world model, batch {batch}", "steps/s", speeds)
    policy.post_training_parameters(config.post_train.lora_rank)
    objective = LOOPLoss(actor, functional=False)
    decisions = wave[wave[keys.MASK]]
    decisions[keys.ADVANTAGE] = torch.randn(len(decisions), 1)
    picked = lambda: decisions[torch.randint(len(decisions), (256,))]  # noqa: E731
    report(
        "LOOP, minibatch 256",
        "steps/s",
        rate(lambda: train(lambda: objective(picked())["loss_objective"], 2), settings.repeats),
    )

    with tempfile.TemporaryDirectory() as folder:
        count = iter(range(100))

        def write() -> float:
            with RolloutWriter(Path(folder) / f"{next(count)}.mcap") as writer:
                writer.write(demonstrations)
            return float(demonstrations[keys.MASK].sum())

        report("MCAP, written", "env-steps/s", rate(write, settings.repeats))
        path = Path(folder) / "0.mcap"
        report("MCAP, read", "env-steps/s", rate(lambda: float(read_rollouts(path)[keys.MASK].sum()), settings.repeats))
        print(f"{'MCAP, size':<52} {path.stat().st_size / float(demonstrations[keys.MASK].sum()):>9.1f} B/env-step")

    env = physics_waves_env(config, 3, 8)
    waves = GroupCollector(env, actor, groups_per_batch=3, group_size=8)
    report(
        "physics waves (policy), 24 rows",
        "env-steps/s",
        rate(lambda: float(waves.next()["next", keys.STEP_MASK].sum()), 1),
    )
    waves.shutdown()
    print(f"{'peak memory':<52} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:>9.0f} MB")


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
