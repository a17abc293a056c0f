"""How many recorded rollouts replay bit for bit: ``python recipes/benchmarks/replay.py [--rollouts 200] [--run RUN]``.

Rollouts of all built-in tasks, half of them step by step (the scripted expert, disturbed), half in chunks of random
actions, recorded from batches and replayed alone in fresh envs. With a finished run's folder, imagined rollouts, too.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the recipes beside this folder

from command_line import refusals
from threads import use_threads
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.devices import choose_device
from worldenv_trl.envs import ExpertPolicy, ImaginedEnv, Reflect, TabletopEnv, chunked
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.policies import OFTPolicy, laplace_actor
from worldenv_trl.record import RolloutWriter, provenance, read_rollouts, replay
from worldenv_trl.reflectors import CompactReflector
from worldenv_trl.scenes import list_suites, list_tasks
from worldenv_trl.world_models import VideoWorldModel


@dataclass(frozen=True)
class Benchmark:
    """What is replayed."""

    rollouts: int = 200
    """Of the physics, over all built-in tasks."""
    max_steps: int = 64
    run: Path | None = None
    """A run folder with checkpoints and exploration: imagined rollouts are replayed, too."""
    imagined: int = 32
    num_threads: int = 1
    """Of what is recorded; its replays take as many."""
    device: str = "cpu"
    """Of the models."""


def physics(settings: Benchmark, path: Path) -> int:
    tasks = [task for suite in list_suites() for task in list_tasks(suite)]
    rows = max(len(tasks), 20)
    torch.manual_seed(0)
    options = {"max_steps": settings.max_steps, "with_sim_state": True, "terminate_on_success": False, "seed": 0}
    env = TabletopEnv(tasks, rows, cameras=("agentview", "wrist"), **options)
    expert = ExpertPolicy(env)

    def disturbed(td):
        td = expert(td)
        return td.set(keys.ACTION, td[keys.ACTION] + 0.1 * torch.randn_like(td[keys.ACTION]))

    written = 0
    for name, player in (("steps", disturbed), ("chunks", None)):
        around = env if name == "steps" else chunked(env)
        with RolloutWriter(path / f"{name}.mcap", **provenance(around)) as writer:
            count = settings.rollouts // 2 if name == "steps" else settings.rollouts - settings.rollouts // 2
            for first in range(0, count, rows):
                collector = GroupCollector(around, player, groups_per_batch=rows, group_size=1)
                writer.write(next(iter(collector))[: count - first, 0])
            written += count
    env.close()
    print(f"{written} rollouts of {len(tasks)} tasks: {', '.join(tasks)}")
    return written


def imagined(settings: Benchmark, path: Path) -> VideoWorldModel:
    load, device = settings.run / "checkpoints", choose_device(settings.device)
    model = VideoWorldModel.from_pretrained(load / "world_model", device=device).eval()
    reflector = CompactReflector.from_pretrained(load / "reflector", device=device).eval()
    policy = OFTPolicy.from_pretrained(load / "sft", device=device).eval()
    contexts = read_rollouts(settings.run / "rollouts" / "explore.mcap", rollouts=range(8))[:, 0]
    env = ImaginedEnv(
        model,
        ForwardKinematics().to(device),
        contexts,
        [settings.imagined // 8, 8],
        max_steps=settings.max_steps,
        seed=0,
        device=device,
    ).append_transform(Reflect(reflector))
    collector = GroupCollector(env, laplace_actor(policy), groups_per_batch=settings.imagined // 8)
    with RolloutWriter(path / "imagined.mcap", **provenance(env, models={"world_model": model})) as writer:
        writer.write(next(iter(collector)))
    return model


def count(file: Path, number: int, **options) -> None:
    started, exact, steps, first, together = time.perf_counter(), 0, 0, [], 0
    for rollout in range(number):
        report = replay(file, rollout, write=False, **options)
        exact, steps = exact + bool(report.exact), steps + report.steps
        together += any("of its wave" in note for note in report.notes)
        if not report.exact:
            first.append(f"  {file.name}, rollout {rollout}: {report.first}; {'; '.join(report.notes)}")
    seconds = time.perf_counter() - started
    alone = f", {together} of them only with the rows they were recorded with" if together else ""
    print(f"{file.stem}: {exact} of {number} bit-exact ({steps} steps){alone}; {seconds / number:.2f} s each")
    print("\n".join(first[:5]))


def main(settings: Benchmark) -> None:
    with refusals():
        use_threads(settings.num_threads)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        physics(settings, path)
        count(path / "steps.mcap", settings.rollouts // 2)
        count(path / "chunks.mcap", settings.rollouts - settings.rollouts // 2)
        if settings.run is not None:
            model = imagined(settings, path)
            count(path / "imagined.mcap", settings.imagined, world_model=model)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
