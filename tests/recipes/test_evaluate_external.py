"""A policy behind a server in the recipes: evaluated like any other, in the scenes and in imagination."""

from __future__ import annotations

import dataclasses
import shutil
from typing import ClassVar

import numpy as np
import pytest
import torch
from policies.policy_servers import ServerProcess, serving

import config
from evaluate import evaluate
from evaluate_external import Settings, command_line, main
from imagination import Imagination
from outcomes import imagined_outcomes
from parts import COMPACT, Part, make_policy
from run_folder import RunFolder
from stages import open_run, rerun
from world_env import run_all
from worldenv_trl.policies import ExternalPolicy, OFTPolicy, laplace_actor
from worldenv_trl.policies.bridge import Description, PolicyServer
from worldenv_trl.record import read_metadata, read_rollouts


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A compact policy of the smoke preset's sizes: its checkpoint, and the server of it."""
    torch.manual_seed(0)
    settings = dataclasses.replace(config.PRESETS["smoke"][1], tasks=config.GOAL_TASKS[1:2])
    checkpoint = make_policy(settings).save_pretrained(tmp_path_factory.mktemp("served"))
    with ServerProcess(checkpoint) as process:
        yield checkpoint, process.address


def lines(settings, stage):
    return [
        {k: v for k, v in line.items() if k != "seconds"} for line in RunFolder(settings.run_dir).read_metrics(stage)
    ]


def test_the_stage_evaluate_takes_it_as_a_part_and_finds_what_it_finds_of_the_served_policy(tiny, served, tmp_path):
    checkpoint, address = served
    tiny = dataclasses.replace(tiny, post_train=dataclasses.replace(tiny.post_train, env="tabletop", probe_every=0))
    loaders = {"local": OFTPolicy.from_pretrained, "external": ExternalPolicy.from_pretrained}
    found, recorded = {}, {}
    for kind, load in loaders.items():
        settings = dataclasses.replace(tiny, run_dir=tmp_path / kind)
        run = open_run(settings, dataclasses.replace(COMPACT, policy=Part(make_policy, load)))
        for name in ("sft", "post_train"):
            if kind == "local":
                shutil.copytree(checkpoint, run.folder.checkpoint(name))
            else:
                ExternalPolicy.connect(address).save_pretrained(run.folder.checkpoint(name))
        rerun("evaluate", evaluate, run)
        found[kind] = lines(settings, "evaluate")
        recorded[kind] = read_rollouts(run.folder.rollouts("evaluate_physics_post_train"))
    assert found["local"] and found["local"] == found["external"]
    chunks = [recorded[kind]["vla_action", "chunk"] for kind in loaders]
    assert torch.equal(*chunks) and chunks[0].abs().sum() > 0


def test_a_run_that_would_train_it_is_refused_in_one_line(tiny, served, monkeypatch):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    external = Part(lambda settings: ExternalPolicy.connect(served[1]), ExternalPolicy.from_pretrained)
    with pytest.raises(SystemExit, match=r"error: the policy served at .* not trained: its weights .*stage sft"):
        run_all(tiny, dataclasses.replace(COMPACT, policy=external))


def test_it_acts_in_imagination_and_beside_a_run(tiny, served, capsys, monkeypatch):
    """A whole run, then the recipe: the run's own policy is served, so both have one success, and one imagination."""
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)
    run_all(tiny)
    capsys.readouterr()
    folder = RunFolder(tiny.run_dir)
    before = folder.read_metrics()
    with ServerProcess(folder.checkpoint("post_train")) as process:
        main(Settings(process.address, tiny, against="post_train", imagined=2))
        own = open_run(tiny)
        imagination = Imagination.load(own, "")
        pair = [
            imagined_outcomes(own, laplace_actor(policy), imagination, imagination.contexts)
            for policy in (own.policy("post_train"), ExternalPolicy.connect(process.address))
        ]
        assert torch.equal(*pair)
    said = capsys.readouterr().out
    assert "external (OFTPolicy post_train): " in said and "training contexts, imagined: " in said
    logged = folder.read_metrics("external")
    rates = {line["policy"]: line["success"] for line in logged if line.get("task") == "all" and "policy" in line}
    assert rates.keys() == {"external", "post_train"} and rates["external"] == rates["post_train"]
    assert [line for line in logged if line.get("paired") and line["task"] == "all"]
    assert folder.read_metrics()[: len(before)] == before  # nothing of the run is lost
    recorded = [read_rollouts(folder.rollouts(f"evaluate_physics_{name}")) for name in ("post_train", "external")]
    assert torch.equal(*(each["vla_action", "chunk"] for each in recorded))


def test_the_scenes_show_what_the_server_asks_for(tiny):
    """Two cameras of 48 px, chunks of 5 and measured proprioception, in a run of one camera, 64 px and chunks of 8."""

    class Watching:
        description = Description("watching", ("wrist", "agentview"), image_size=48, chunk_length=5, proprio="measured")
        seen: ClassVar[list] = []

        def __call__(self, images, state, instructions):
            self.seen.append(({name: image.shape for name, image in images.items()}, list(instructions)))
            return np.full((len(state), 5, 7), 0.1, np.float32)

    act = Watching()
    with serving(PolicyServer(act, act.description)) as address:
        main(Settings(address, tiny, name="watching"))
    shapes, instructions = act.seen[0]
    assert shapes == {"wrist": (2, 3, 48, 48), "agentview": (2, 3, 48, 48)}
    assert instructions == 2 * ["open the top drawer of the cabinet"]
    assert len(act.seen) == 4  # decisions of 5 steps in 16
    about = read_metadata(RunFolder(tiny.run_dir).rollouts("evaluate_physics_watching"))["env"]
    assert (about["proprio"], about["cameras"]) == ("measured", ["wrist", "agentview"])
    assert lines(tiny, "watching")[0]["episodes"] == 2


def test_names_of_the_run_are_not_overwritten_and_a_missing_server_is_told_before_all_else(tiny, served):
    for name in ("sft", "post_train", "evaluate", "", "../elsewhere"):
        with pytest.raises(SystemExit, match=f"error: --name '{name}' is the run's own or no name of a folder"):
            main(Settings(served[1], tiny, name=name))
    with pytest.raises(SystemExit, match=r"checkpoints/post_train does not exist: run the stage 'post_train'"):
        main(Settings(served[1], tiny, against="post_train"))
    fresh = dataclasses.replace(tiny, run_dir=tiny.run_dir / "fresh")
    with pytest.raises(SystemExit, match="error: no policy server answers at unix:/nowhere"):
        main(Settings("unix:/nowhere", fresh))
    assert not fresh.run_dir.exists()


def test_a_server_that_dies_in_an_evaluation_ends_it_in_one_line(tiny):
    calls = []

    def dies(images, state, instructions):
        calls.append(len(state))
        if len(calls) == 2:
            server.close()
        return np.zeros((len(state), 8, 7), np.float32)

    server = PolicyServer(dies, Description("dies", ("agentview",), 64, 8, "commanded"))
    with serving(server) as address, pytest.raises(SystemExit, match=f"error: no policy server answers at {address}"):
        main(Settings(address, tiny))
    assert not RunFolder(tiny.run_dir).done("external")


def test_the_command_line_takes_a_preset_and_needs_an_address(capsys):
    settings = command_line(["smoke", "--address", "localhost:1", "--seed", "3", "--against", "sft"])
    assert (settings.address, settings.config.seed, settings.against) == ("localhost:1", 3, "sft")
    with pytest.raises(SystemExit):
        command_line(["smoke"])
    assert "address" in capsys.readouterr().err
