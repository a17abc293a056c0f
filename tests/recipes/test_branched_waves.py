"""Waves of LOOP whose groups begin in the middle of explored episodes."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from demonstrate import demonstrate
from explore import explore
from parts import COMPACT
from post_train import collected_returns, post_train
from run import write_rules
from stages import open_run
from worldenv_trl import keys
from worldenv_trl.record import read_rollouts
from worldenv_trl.reflectors import StopRule


@pytest.fixture
def run(tiny, monkeypatch):
    """Untrained parts and an exploration of theirs, in episodes of three chunks; all groups branch."""
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 24 steps are too few for the expert
    learned = dataclasses.replace(tiny.post_train, iterations=3, probe_every=0, branch_share=1.0, branch_until=8)
    run = open_run(dataclasses.replace(tiny, max_steps=24, post_train=learned))
    torch.manual_seed(0)
    for name, part in (("sft", "policy"), ("world_model", "world_model"), ("reflector", "reflector")):
        getattr(COMPACT, part).make(run.config).save_pretrained(run.folder.checkpoint(name))
    never = StopRule(0.999, 30)
    write_rules(run.folder.checkpoint("reflector"), {"imagined": never, "real": never})
    demonstrate(run)
    explore(run)
    yield run
    run.close()


@pytest.mark.parametrize("collectors", ["local", "process:2"])
def test_waves_that_are_not_recorded_begin_in_explored_episodes(run, collectors):
    run = dataclasses.replace(run, config=dataclasses.replace(run.config, collectors=collectors))
    decisions = []

    def returns_of(wave):
        decisions.append(wave[keys.MASK].sum(-1).unique().tolist())
        return collected_returns(wave)

    post_train(run, "sft", "post_train", "", returns_of=returns_of)
    assert decisions == [[3], [2], [3]]  # the first and the last are relived by the report
    for iteration in (0, 2):
        rollouts = read_rollouts(run.folder.rollouts(f"post_train_{iteration:03d}"))
        assert (rollouts["next", keys.NUM_STEPS][..., 0, :] == 8).all()
    run.close()


def test_what_cannot_be_branched_is_refused_before_any_work(tiny):
    for change, message in (
        ({"branch_share": 1.5}, "post_train.branch_share must lie between 0 and 1, got 1.5"),
        ({"branch_share": 0.5, "branch_until": 16}, "branch_until, .* at least 8, chunk_length, and below 16"),
        ({"branch_share": 0.5, "branch_until": 4}, "branch_until, .* at least 8, chunk_length, and below 16"),
        ({"branch_share": 0.5, "branch_until": 8, "iterations": 2}, "post_train.iterations must be at least 3"),
    ):
        learned = dataclasses.replace(tiny.post_train, **change)
        with pytest.raises(SystemExit, match=message):
            open_run(dataclasses.replace(tiny, post_train=learned))
    assert not tiny.run_dir.exists()
