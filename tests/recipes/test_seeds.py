"""Every use of random numbers has a seed of its own."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from types import SimpleNamespace

import pytest
import torch

import explore as explore_stage
import imagination
import post_train as post_train_stage
from config import PRESETS
from run import Run
from run_folder import RunFolder
from seeds import stage_seed
from stages import plan


def test_a_seed_is_63_bits_of_the_sha256_of_seed_stage_and_use():
    assert stage_seed(3, "explore_2") == int(hashlib.sha256(b'[3, "explore_2", ""]').hexdigest()[:16], 16) // 2
    assert 0 <= stage_seed(0, "sft") < 2**63


def test_no_two_stages_rounds_or_runs_share_a_stream():
    names = [stage.name for stage in plan(dataclasses.replace(PRESETS["smoke"][1], rounds=12))]
    runs = [Run(dataclasses.replace(PRESETS["smoke"][1], seed=seed), RunFolder("nowhere")) for seed in range(30)]
    firsts = []
    for run, name in itertools.product(runs, names):
        run.seed_everything(name)
        firsts.append(torch.rand(4, dtype=torch.float64))
    assert len(torch.stack(firsts).unique(dim=0)) == len(runs) * len(names)


class Reached(Exception):
    """The stage has come far enough."""


@pytest.fixture
def seen(monkeypatch, tiny):
    """What a stage's generators are seeded with: ``seen(work, **options)``."""
    run = Run(tiny, RunFolder(tiny.run_dir))

    def stop(*_, seed, **__):
        raise Reached(seed)

    monkeypatch.setattr(Run, "policy", lambda *_: torch.nn.Identity())
    monkeypatch.setattr(explore_stage, "step_env", stop)
    actor = SimpleNamespace(policy=SimpleNamespace(in_keys=[]))
    monkeypatch.setattr(post_train_stage, "exploring_actor", lambda *_: actor)
    monkeypatch.setattr(torch.nn.Identity, "post_training_parameters", lambda *_: {}, raising=False)
    monkeypatch.setattr(imagination.Imagination, "load", classmethod(lambda *_: imagination.Imagination(*[None] * 4)))
    monkeypatch.setattr(imagination.Imagination, "env", stop)

    def drawn(work, **options):
        with pytest.raises(Reached) as stopped:
            work(run, **options)
        return stopped.value.args[0], torch.initial_seed()

    return drawn


def test_exploration_and_loop_draw_other_states_and_noise_in_every_round(seen):
    rounds = [f"_{number}" for number in range(2, 10)]
    explored = [seen(explore_stage.explore, target=f"explore{name}") for name in rounds]
    learned = [
        seen(post_train_stage.post_train, source="sft", target=f"post_train{name}", models=name) for name in rounds
    ]
    drawn = [number for pair in explored + learned for number in pair]
    assert len(set(drawn)) == len(drawn) == 32
