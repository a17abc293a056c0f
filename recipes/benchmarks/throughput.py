"""Speeds of every part on a device: ``python recipes/benchmarks/throughput.py [--device cuda] [--num-threads 2]``.

Prints one line a figure: median of repeats per second of the clock, [their range], per core-second (processor time of
all threads and helpers), and what one unit costs in yardsticks, core-second by core-second. A yardstick is an env step
as MuJoCo alone does it: ten ``mj_step`` and one frame by its own renderer, on the same model, in the same run. Machines
differ; ratios travel. The models are untrained: nothing is learned and nothing is kept.
"""

from __future__ import annotations

import dataclasses
import math
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import BCLoss

from command_line import at_least, refusals
from config import WorldEnvConfig
from data_parallel import DataParallel
from imagination import Imagination
from parts import COMPACT
from physics import exploring_actor, physics_waves_env, tabletop
from run import Run
from run_folder import RunFolder
from speeds import Speed, drawing_yardstick, finish, flops, matmul_bound, physics_yardstick, speed
from threads import use_threads
from updates import update
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import Episodes, episodes_from_rollouts, policy_samples, window_buffer
from worldenv_trl.devices import choose_device, to_device
from worldenv_trl.envs import ExpertPolicy
from worldenv_trl.language import instructions_of
from worldenv_trl.objectives import LOOPLoss, WorldModelLoss, rloo_advantage
from worldenv_trl.policies import DeviceBridge, LaplaceActor, Policy, laplace_actor
from worldenv_trl.record import RolloutWriter, read_rollouts
from worldenv_trl.reflectors import StopRule
from worldenv_trl.scenes import load_task
from worldenv_trl.scenes.panda import SUBSTEPS
from worldenv_trl.world_models import VideoWorldModel, WorldModel


@dataclass(frozen=True)
class Benchmark:
    """What is measured, and how often."""

    device: str = "auto"
    """Of the models: ``cpu``, ``cuda``, ``cuda:N``, or ``auto``, CUDA where there is one. The physics is on the CPU."""
    num_threads: int = 2
    repeats: int = 3
    rows: tuple[int, ...] = (1, 16, 64)
    """Batch sizes of TabletopEnv."""
    groups: int = 24
    """Of an iteration of LOOP, ..."""
    group_size: int = 8
    """... and rollouts of each."""


class _Timed(WorldModel):
    """A world model that adds up the seconds spent inside it."""

    def __init__(self, model: VideoWorldModel, device: torch.device) -> None:
        sizes = {"image_size": model.image_size, "chunk_length": model.chunk_length}
        super().__init__(cameras=model.cameras, instructions=model.seen.instructions, **sizes)
        self.model, self.device, self.seconds = model, device, 0.0
        self.asked: TensorDictBase | None = None

    def memory_indices(self, now: torch.Tensor) -> torch.Tensor:
        return self.model.memory_indices(now)

    def forward(self, tensordict: TensorDict) -> TensorDict:
        self.asked = tensordict.copy() if self.asked is None else self.asked
        finish(self.device)
        started = time.perf_counter()
        out = self.model(tensordict)
        finish(self.device)
        self.seconds += time.perf_counter() - started
        return out


class Table:
    """Prints figures as they are measured."""

    def __init__(self, yardstick: float) -> None:
        self.yardstick = yardstick  # core-seconds
        print(f"{'':<46}{'per second':>12} {'[range]':<18}{'per core-second':>16}{'yardsticks each':>17}")

    def line(self, name: str, unit: str, measured: Speed) -> None:
        span = f"[{_short(min(measured.per_second))}, {_short(max(measured.per_second))}]"
        each = 1 / measured.core / self.yardstick
        print(
            f"{name + ', ' + unit:<46}{_short(measured.wall):>12} {span:<18}{_short(measured.core):>16}"
            f"{_short(each):>17}",
            flush=True,
        )


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def main(settings: Benchmark) -> None:
    with refusals():
        device = choose_device(settings.device)
        use_threads(settings.num_threads)
        at_least(1, repeats=settings.repeats, rows=settings.rows)
        at_least(1, groups=settings.groups)
        at_least(2, group_size=settings.group_size)
    torch.manual_seed(0)
    config = WorldEnvConfig(num_threads=settings.num_threads, device=settings.device)
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"models on {device} ({where}), physics on {settings.num_threads} threads, median of {settings.repeats}")
    task, repeats = load_task(config.tasks[0]), settings.repeats
    stepped = physics_yardstick(task, repeats)
    drawn = drawing_yardstick(task, config.cameras[0], config.image_size, repeats)
    yardstick = SUBSTEPS / stepped.core + 1 / drawn.core
    print(f"a yardstick is {1e3 * yardstick:.3g} ms of a core: {SUBSTEPS} mj_step and a {config.image_size} px frame")
    table = Table(yardstick)
    table.line("mj_step alone", "steps", stepped)
    table.line("MuJoCo's renderer alone", "frames", drawn)
    _physics(settings, config, table)

    demonstrations = _demonstrated(config)
    run = Run(config, RunFolder(config.run_dir))
    made = (part.make(config).to(device) for part in (COMPACT.policy, COMPACT.world_model, COMPACT.reflector))
    policy, model, reflector = made
    contexts = to_device(demonstrations[:, 0], device)
    timed = _Timed(model.eval(), device)
    env = Imagination(timed, reflector.eval(), StopRule(0.999), contexts).env(
        run, [settings.groups, settings.group_size], seed=0
    )
    episodes = episodes_from_rollouts(demonstrations)
    _supervised(settings, run, policy, model, episodes, table)
    _loop(settings, run, env, policy, timed, table)
    _recording(repeats, demonstrations, table)
    waves = GroupCollector(
        physics_waves_env(config, 3, 8), DeviceBridge(laplace_actor(policy)), groups_per_batch=3, group_size=8
    )
    walked = speed(lambda: float(waves.next()["next", keys.STEP_MASK].sum()), 1, device)
    table.line("physics waves (policy), 24 rows", "env-steps", walked)
    waves.shutdown()
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:,.0f} MB", end="")
    print(f", of the GPU {torch.cuda.max_memory_allocated(device) / 2**20:,.0f} MB" if device.type == "cuda" else "")


def _physics(settings: Benchmark, config: WorldEnvConfig, table: Table) -> None:
    for rows in settings.rows:
        env = tabletop(config, "train", rows, config.tasks[:1], terminate_on_success=False)
        steps = max(20, 640 // rows)

        def play(env=env, steps=steps, rows=rows) -> float:
            return rows * env.rollout(steps, break_when_any_done=False).shape[1]

        table.line(f"TabletopEnv, 64 px, {rows} rows", "env-steps", speed(play, settings.repeats))
        env.close()


def _demonstrated(config: WorldEnvConfig) -> TensorDictBase:
    env = tabletop(config, "train", 15, None, init_state_mode="cycle")
    demonstrations = next(iter(GroupCollector(env, ExpertPolicy(env), groups_per_batch=15)))[:, 0]
    env.close()
    return demonstrations


def _supervised(
    settings: Benchmark, run: Run, policy: Policy, model: VideoWorldModel, episodes: Episodes, table: Table
) -> None:
    def steps(loss: Callable[[], torch.Tensor], count: int) -> float:
        for _ in range(count):
            loss().backward()
        return count

    samples = policy_samples(episodes)
    with warnings.catch_warnings(action="ignore"):  # about its own annotations
        cloning = BCLoss(laplace_actor(policy), loss_function="l1")
    cloning.set_keys(action=keys.CHUNK, pad_mask=keys.ACTION_IS_PAD)

    def cloned() -> torch.Tensor:
        return cloning(to_device(samples[torch.randint(len(samples), (64,))], run.device))["loss_bc"]

    table.line("SFT, batch 64", "steps", speed(lambda: steps(cloned, 5), settings.repeats, run.device))
    size = run.config.world_model.batch_size
    windows = window_buffer(episodes, run.kinematics, model.train(), batch_size=size)
    loss = WorldModelLoss(model)
    trained = speed(lambda: steps(lambda: loss(windows.sample())["loss_world_model"], 3), settings.repeats, run.device)
    table.line(f"world model training, batch {size}", "steps", trained)
    model.eval()


def _loop(settings: Benchmark, run: Run, env: EnvBase, policy: Policy, timed: _Timed, table: Table) -> None:
    """Imagined rollouts, and whole iterations of LOOP; both beside what the device's matrix products allow."""
    learned = dataclasses.replace(run.config.post_train, max_kl=math.inf)  # the policy is untrained: it may move far
    groups = policy.post_training_parameters(learned.lora_rank)
    actor = exploring_actor(run.config, policy, learned.scale_factor, learned.noise)
    collector = GroupCollector(env, actor, groups_per_batch=settings.groups)
    collector.exclude = [("next", "observation")]
    loss = LOOPLoss(actor, clip_epsilon=learned.clip_epsilon, functional=False)
    learner = DataParallel(policy, lambda _: loss)
    optimizer = torch.optim.AdamW([{"params": group} for group in groups.values()], lr=1e-6, weight_decay=0.0)
    waves: list[TensorDictBase] = []
    inside, updates = [], []

    def imagine() -> float:
        timed.seconds, started = 0.0, time.perf_counter()
        wave = collector.next()
        finish(run.device)
        inside.append(timed.seconds / (time.perf_counter() - started))
        waves[:] = [wave]
        return float((wave["next", keys.STEP_MASK] & wave[keys.MASK][..., None]).sum())

    def iterate() -> float:
        imagine()
        (wave,) = waves
        wave[keys.ADVANTAGE] = rloo_advantage(wave["returns"][..., 0])[..., None, None].expand(*wave.shape, 1)
        updates.append(update(wave, policy.in_keys, learner, optimizer, list(groups.values()), learned)["updates"])
        return 1.0

    rows = settings.groups * settings.group_size
    imagined = speed(imagine, settings.repeats, run.device)
    table.line(f"imagination (policy, reflector), {rows} rows", "frames", imagined)
    print(f"  {100 * (1 - sum(inside[1:]) / len(inside[1:])):.0f} % of that time outside the world model")
    iteration = speed(iterate, settings.repeats, run.device)
    table.line(f"LOOP, {settings.groups} x {settings.group_size} rollouts", "iterations", iteration)
    steps = sum(updates[1:]) / len(updates[1:])
    print(f"  {1 / iteration.wall:.3g} s an iteration, {steps:.0f} updates in it")
    work = counted(policy, actor, timed, waves[0], loss, learned.epochs)
    _bound(run.device, work, timed.model.predicts_in_bfloat16(run.device), imagined, iteration, settings.repeats)


@dataclass(frozen=True)
class Work:
    """Floating-point operations."""

    painted: float
    """Of the world model for a frame."""
    acted: float
    """Of the policy for a frame."""
    learned: float
    """Of an iteration's updates."""


def counted(
    policy: Policy, actor: LaplaceActor, timed: _Timed, wave: TensorDictBase, loss: LOOPLoss, epochs: int
) -> Work:
    """What the models compute, counted on a few rows of a wave."""
    assert timed.asked is not None
    chunk, asked = timed.chunk_length, timed.asked[: min(8, len(timed.asked))]
    decisions = wave.reshape(-1)[wave[keys.MASK].flatten()]
    some = decisions[torch.arange(min(8, len(decisions)))]
    some.set(keys.INSTRUCTION, instructions_of(some)[0])
    painted = flops(lambda: timed.model(asked)) / (len(asked) * chunk)
    with torch.no_grad():
        acted = flops(lambda: actor(some.copy())) / (len(some) * chunk)
    learned = flops(lambda: loss(some)["loss_objective"].backward()) / len(some)
    policy.zero_grad()
    return Work(painted, acted, epochs * len(decisions) * learned)


def _bound(device: torch.device, work: Work, half: bool, imagined: Speed, iteration: Speed, repeats: int) -> None:
    """The share of the device's own matrix products that imagination and LOOP's updates reach: per second of a GPU, per
    core-second of a processor, which others may use, too."""
    on_cpu = device.type == "cpu"

    def rate(measured: Speed) -> float:
        return measured.core if on_cpu else measured.wall

    bounds = {
        name: rate(matmul_bound(device, dtype, repeats))
        for name, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16))
    }
    products = ", ".join(f"{each / 1e9:,.0f} GFLOP/s in {name}" for name, each in bounds.items())
    print(f"matrix products alone{', per core' if on_cpu else ''}: {products}")
    # Each part by the products of its own precision: time that they alone would take, of the time that it took.
    precision = "bfloat16" if half else "float32"
    share = rate(imagined) * (work.painted / bounds[precision] + work.acted / bounds["float32"])
    frame = f"{(work.painted + work.acted) / 1e6:,.1f} MFLOP a frame, {work.painted / 1e6:,.1f} of them in {precision}"
    print(f"imagination: {frame}; {100 * share:.3g} % of the matmul bound")
    share = rate(iteration) * work.learned / bounds["float32"]
    print(f"LOOP: {work.learned / 1e9:,.1f} GFLOP of updates; {100 * share:.3g} % of the bound over a whole iteration")


def _recording(repeats: int, demonstrations: TensorDictBase, table: Table) -> None:
    with tempfile.TemporaryDirectory() as folder:
        count, executed = iter(range(100)), float(demonstrations[keys.MASK].sum())

        def write() -> float:
            with RolloutWriter(Path(folder) / f"{next(count)}.mcap") as writer:
                writer.write(demonstrations)
            return executed

        table.line("MCAP, written", "env-steps", speed(write, repeats))
        path = Path(folder) / "0.mcap"
        table.line("MCAP, read", "env-steps", speed(lambda: float(read_rollouts(path)[keys.MASK].sum()), repeats))
        print(f"  {path.stat().st_size / executed:.1f} B an env step")


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
