"""How success grows with real rollouts: LOOP in the physics from the SFT policy of an existing run, one seed.

``python recipes/benchmarks/learning.py improve --source runs/improve --run-dir runs/curve_0 --num-threads 1``: a preset
and settings as for ``recipes/world_env.py``; ``post-train.iterations`` times ``groups`` times ``group-size`` rollouts.
Greedy and sampled success on training and on validation states is written point by point; a curve that was interrupted
begins again. Nothing is held: all tasks learn. ``recipes/benchmarks/learning_plot.py runs/curve_*`` draws several.
"""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torchrl.envs.utils import ExplorationType

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from command_line import refusals
from config import PRESETS, WorldEnvConfig
from corrupted_returns import CorruptedReturns, Corruption, check_corruption
from learning_curves import STAGE, describe, log_point, measured_iterations, measured_states
from outcomes import physics_outcomes
from physics import exploring_actor
from post_train import collected_returns, post_train
from run import Run
from run_folder import RunFolder
from stages import open_run, rerun
from worldenv_trl.metrics import advantage_correlation
from worldenv_trl.policies import Policy, policy_actor
from worldenv_trl.report import RunRecord

_SHARED = ("tasks", "cameras", "image_size", "chunk_length", "max_steps")  # a policy is of these


@dataclass(frozen=True)
class Learning:
    """One curve."""

    source: Path
    """Run folder whose checkpoint sft is where LOOP begins."""
    config: Annotated[WorldEnvConfig, tyro.conf.arg(name="")]
    corruption: Corruption = field(default_factory=Corruption)
    states: int = 100
    """States of each task in every measurement: so many training and so many validation states."""
    growth: float = 2.0
    """From one measurement to the next LOOP has seen so many times as many rollouts."""
    sampled: bool = True
    """Measure sampled success, too; it takes as long as greedy success."""
    label: str = ""
    """Of the variant, in plots: curves of one label are its seeds. By default what corrupts the returns."""


class Measured:
    """What a curve sees of LOOP: each wave, and from time to time the policy."""

    def __init__(self, run: Run, settings: Learning) -> None:
        self.run, self.settings = run, settings
        self.states = measured_states(run.config, settings.states)
        self.corrupted = CorruptedReturns(settings.corruption, run.config.seed)
        learned = run.config.post_train
        self.at = measured_iterations(learned.iterations, settings.growth)
        self.wave_rollouts, self.waves = learned.groups * learned.group_size, 0

    def returns_of(self, wave: Any) -> torch.Tensor:
        """``[G, N]``, corrupted; logs what they say of the truth."""
        true, seen = collected_returns(wave), self.corrupted(wave)
        correlation, mixed = advantage_correlation(seen, true)
        line = {"wave": self.waves, "success": true.mean().item(), "return": seen.mean().item(), "mixed_groups": mixed}
        self.run.folder.log(STAGE, **line, **({"correlation": correlation} if mixed else {}))
        self.waves += 1
        return seen

    def watch(self, iterations: int, policy: Policy) -> None:
        """Measures the policy if it is its turn; what LOOP draws after it does not depend on that."""
        if iterations not in self.at:
            return
        config, sampled = self.run.config, self.settings.sampled
        actors = {"greedy": (policy_actor(policy), ExplorationType.DETERMINISTIC)}
        if sampled:
            actor = exploring_actor(config, policy, config.post_train.scale_factor, config.post_train.noise)
            actors["sampled"] = (actor, ExplorationType.RANDOM)
        for split, indices in self.states.items():
            for mode, (actor, exploration_type) in actors.items():
                with torch.random.fork_rng():
                    self.run.seed_everything("learning")  # the same noise for every policy of the curve
                    outcomes = {
                        task: physics_outcomes(
                            self.run,
                            actor,
                            task,
                            "train",
                            len(indices),
                            indices=indices,
                            exploration_type=exploration_type,
                        )
                        for task in config.tasks
                    }
                log_point(self.run.folder, iterations, iterations * self.wave_rollouts, split, mode, outcomes)


def main(settings: Learning) -> None:
    learned = dataclasses.replace(settings.config.post_train, env="tabletop", probe_every=0, hold=0.0)
    adapt = dataclasses.replace(settings.config.adapt, steps=0)  # the preset's, of imagination
    config = dataclasses.replace(settings.config, post_train=learned, adapt=adapt)
    with refusals():
        check_corruption(settings.corruption, len(config.tasks))
        measured_iterations(learned.iterations, settings.growth)
        measured_states(config, settings.states)
        checkpoint = start_of(settings.source, config)
    if settings.config.post_train.hold:
        print("all tasks learn: --post-train.hold is not for a curve, whose folder holds no exploration")
    run = open_run(config)
    with refusals():
        describe(run.folder, description(settings, checkpoint))
    if run.folder.done(STAGE):
        print(f"{config.run_dir}: finished, skipped")
        return
    shutil.copytree(checkpoint, run.folder.checkpoint("sft"), dirs_exist_ok=True)
    measured = Measured(run, settings)
    with run.folder.stage(STAGE):
        run.folder.forget("post_train")  # the returns' own random numbers are not in its checkpoints
        rerun("post_train", partial(post_train, returns_of=measured.returns_of, watch=measured.watch), run)


def start_of(source: Path, config: WorldEnvConfig) -> Path:
    """The checkpoint sft of a run.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is of other tasks, cameras, sizes or lengths, or the curve would be written into it.
    """
    checkpoint = RunFolder(source).require_checkpoint("sft", "sft")
    if source.resolve() == config.run_dir.resolve():
        raise ValueError(f"--run-dir is the --source, {source}: name a folder for the curve alone")
    stored = RunRecord.read(source).config
    for name in _SHARED:
        now = getattr(config, name)
        now = list(now) if isinstance(now, tuple) else now
        if stored[name] != now:
            raise ValueError(f"{source} was made with {name}={stored[name]!r}, now {now!r}: pass the same")
    return checkpoint


def description(settings: Learning, checkpoint: Path) -> dict[str, Any]:
    """What ``config.yaml`` does not say of a curve."""
    digest = hashlib.sha256()
    for path in sorted(checkpoint.rglob("*")):
        digest.update(path.read_bytes() if path.is_file() else b"")
    corruption = dataclasses.asdict(settings.corruption)
    corruption["false_success"] = list(corruption["false_success"])
    kept = {name: getattr(settings, name) for name in ("states", "growth", "sampled")}
    label = settings.label or named(settings.corruption)
    return {"label": label, "seed": settings.config.seed, "policy": digest.hexdigest(), "corruption": corruption} | kept


def named(corruption: Corruption) -> str:
    """A corruption in a few words."""
    if corruption.kind == "none":
        return "truth"
    if corruption.false_success:
        shares = ", ".join(f"{share:g}" for share in corruption.false_success)
        return f"{corruption.kind} {shares}{' by context' if corruption.by_context else ''}"
    return f"{corruption.kind}, r = {corruption.correlation:g}"


def parse(arguments: list[str]) -> Learning:
    presets = {name: (what, Learning(source=tyro.MISSING, config=config)) for name, (what, config) in PRESETS.items()}
    return tyro.extras.overridable_config_cli(presets, args=arguments, description=__doc__)


if __name__ == "__main__":
    main(parse(sys.argv[1:]))
