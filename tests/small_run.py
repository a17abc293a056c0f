"""Settings of the whole loop at the smallest scale, which tests change to their needs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

import config
from parts import COMPACT
from run import Run
from stages import open_run
from worldenv_trl.policies import TokenPolicy

SMALL = dataclasses.replace(
    config.PRESETS["smoke"][1],
    num_threads=1,
    tasks=config.GOAL_TASKS[1:2],
    max_steps=16,
    train_states=4,
    demonstrate=config.Demonstrate(episodes_per_task=1),
    sft=config.SFT(steps=3, scale_steps=2),
    explore=config.Explore(episodes_per_task=8, num_envs=4, scale_factors=(1.0,)),
    world_model=config.WorldModel(steps=2, batch_size=2),
    reflector=config.Reflector(encoder_frames=16, prefixes=16, batch_size=4),
    post_train=config.PostTrain(iterations=1, groups=2, group_size=2, epochs=1, probe_contexts=2),
    evaluate=config.Evaluate(episodes_per_task=2, num_envs=2),
)


def with_untrained_policy(settings: config.WorldEnvConfig) -> Run:
    """A run whose fine-tuned policy is as it was made."""
    run = open_run(settings)
    torch.manual_seed(0)
    COMPACT.policy.make(run.config).save_pretrained(run.folder.checkpoint("sft"))
    return run


def small_untrained(folder: Path, **changes: Any) -> Run:
    """The same of :data:`SMALL` with some settings changed, in ``folder``."""
    return with_untrained_policy(dataclasses.replace(SMALL, run_dir=folder / "run", **changes))


def token_policy() -> TokenPolicy:
    """One that acts by tokens and can do nothing else."""
    tokens = type("Tokens", (TokenPolicy,), {})
    tokens.__abstractmethods__ = frozenset()
    return object.__new__(tokens)
