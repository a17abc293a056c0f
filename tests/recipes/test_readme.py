"""The README says what is so."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import torch

from parts import make_policy, make_reflector, make_world_model
from physics import step_env
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.policies import OFTPolicy
from worldenv_trl.record import RolloutWriter, provenance

README = Path(__file__).parents[2] / "README.md"


def test_it_has_fewer_than_1200_words():
    assert len(README.read_text().split()) < 1200


def test_every_file_that_it_names_is_there():
    named = re.findall(r"\]\(([^)#:]+)\)", README.read_text())
    assert named and not [name for name in named if not (README.parent / name).exists()]


def test_its_example_learns(tiny, monkeypatch, capsys):
    config = dataclasses.replace(tiny, max_steps=72, num_threads=1)
    run = config.run_dir
    torch.manual_seed(0)
    policy = make_policy(config)
    policy.save_pretrained(run / "checkpoints" / "sft")
    make_world_model(config).save_pretrained(run / "checkpoints" / "world_model")
    make_reflector(config).save_pretrained(run / "checkpoints" / "reflector")
    env = step_env(config, "train", 4)
    wave = next(iter(GroupCollector(env, None, groups_per_batch=4, max_decisions=2)))[:, 0]
    with RolloutWriter(run / "rollouts" / "explore.mcap", **provenance(env)) as writer:
        writer.write(wave)
    env.close()

    example = re.search(r"```python\n(import torch\n.*?)```", README.read_text(), re.S).group(1)
    smaller = {
        '"runs/smoke"': repr(str(run)),
        "slice(0, 12)": "slice(0, 4)",
        "[12, 8]": "[2, 2]",
        "max_steps=72": "max_steps=16",
        "groups_per_batch=12, total_groups=192": "groups_per_batch=2, total_groups=4",
    }
    for words, fewer in smaller.items():
        assert words in example
        example = example.replace(words, fewer)
    names: dict = {}
    exec(example, names)
    assert capsys.readouterr().out.count("imagined return") == 2
    before, after = policy.state_dict(), names["policy"].state_dict()
    assert isinstance(names["policy"], OFTPolicy)
    heads = [name for name in before if name.startswith("loc_head")]
    assert any(not torch.equal(before[name], after[name]) for name in heads)
