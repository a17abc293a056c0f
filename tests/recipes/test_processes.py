"""Two processes of torchrun compute what one does."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from stages_together import SETTINGS, learn, work

import processes
from run_folder import RunFolder
from stages import open_run, run_stages
from world_env import WORKS

STAGES = {
    "sft": "sft",
    "train_world_model": "world_model",
    "train_reflector": "reflector",
    "adapt": "adapted",
    "post_train": "post_train",
}
PHYSICS = {"adapt": {"steps": 0}, "post_train": {"env": "tabletop", "iterations": 2, "probe_every": 0}}
HOLDING = {"post_train": {"hold": 1.0, "iterations": 3, "probe_every": 0}}


def torchrun(jobs: list[dict], seconds: float = 400.0) -> subprocess.CompletedProcess:
    """Two processes that do these jobs."""
    root = Path(__file__).parents[2]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += [str(Path(__file__).with_name("stages_together.py")), json.dumps(jobs)]
    paths = [root, root / "recipes", root / "tests", os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths)), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=seconds, cwd=root)


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """The folder of a run of one process."""
    path = tmp_path_factory.mktemp("one") / "run"
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
        run_stages(open_run(dataclasses.replace(SETTINGS, run_dir=path)), WORKS | {"post_train": learn})
    torch.set_num_threads(threads)
    return path


def copy_of(run: Path, path: Path, stage: str, settings: dict | None = None) -> Path:
    """The run without what a stage has made of it, and for other settings."""
    shutil.copytree(run, path)
    shutil.rmtree(path / "checkpoints" / stage)
    RunFolder(path).forget(stage)
    if settings is not None:
        (path / "config.yaml").unlink()
    return path


@pytest.fixture(scope="module", params=["ddp", "fsdp"])
def two(one, tmp_path_factory, request):
    """The folders in which two processes did each of the stages again, by its kind."""
    root = tmp_path_factory.mktemp(request.param)
    jobs = [
        {"run": str(copy_of(one, root / kind, stage)), "kind": kind, "settings": {"parallel": request.param}}
        for kind, stage in STAGES.items()
    ]
    for name, settings in (("physics", PHYSICS), ("holding", HOLDING)):
        run = copy_of(one, root / name, "post_train", settings)
        jobs.append({"run": str(run), "kind": "post_train", "settings": settings | {"parallel": request.param}})
    done = torchrun(jobs)
    assert done.returncode == 0, done.stderr[-4000:]
    assert "find_unused_parameters" not in done.stderr  # torch's warning, once a process, where nothing is unused
    return root


def weights(run: Path, stage: str) -> dict[str, torch.Tensor]:
    return load_file(run / "checkpoints" / stage / "model.safetensors")


def furthest(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> float:
    assert first.keys() == second.keys()
    return max(float((first[name].double() - second[name].double()).abs().max()) for name in first)


def lines(run: Path, stage: str) -> list[dict]:
    """What a stage has logged, but for times."""
    return [
        {name: value for name, value in line.items() if "second" not in name}
        for line in RunFolder(run).read_metrics(stage)
    ]


@pytest.mark.parametrize(("kind", "stage"), STAGES.items())
def test_two_processes_reach_the_weights_of_one_after_twenty_updates(one, two, kind, stage):
    assert furthest(weights(one, stage), weights(two / kind, stage)) < 1e-5


@pytest.mark.parametrize("rank", [0, 1])
def test_beside_the_whole_part_a_process_holds_a_share_of_what_learns_alone(two, rank):
    held = json.loads((two / "post_train" / f"held_{rank}.json").read_text())
    assert held["learns"] < held["part"] / 2  # LOOP's adapters and heads: the rest is frozen
    more = held["both"] - held["part"]
    if two.name.startswith("ddp"):
        assert more == 0
    else:
        assert 0 < more < 0.75 * held["learns"]  # half of it, but for what cannot be halved, and buffers


@pytest.mark.parametrize(("kind", "stage"), STAGES.items())
def test_figures_are_of_what_both_learned_from_and_logged_once(one, two, kind, stage):
    expected, found = lines(one, stage), lines(two / kind, stage)
    assert [line.keys() for line in found] == [line.keys() for line in expected]
    for first, second in zip(expected, found, strict=True):
        for name in first:
            if name.startswith(("psnr", "moving", "frame_", "stop_")):
                continue  # of quantised frames, or of scores beside a threshold
            # The effective sample size is a mean of those of the shares, as it is of the parts of a minibatch.
            precision = 2e-3 if name == "ESS" else 1e-4
            assert second[name] == pytest.approx(first[name], abs=precision, nan_ok=True), name


def test_each_process_learns_from_half_the_rows(two):
    rows = {kind: [json.loads((two / kind / f"rows_{rank}.json").read_text()) for rank in range(2)] for kind in STAGES}
    assert rows["sft"] == [25 * [4]] * 2 and rows["train_world_model"] == [20 * [1]] * 2
    assert rows["train_reflector"] == [40 * [4]] * 2
    assert rows["adapt"] == [20 * [8]] * 2  # four decisions, each seen both ways
    # Two groups of nine rollouts of two decisions, twice an iteration, for five; one row for a turn without any.
    mine, other = rows["post_train"]
    assert len(mine) == len(other) > 20 and max(mine + other) == 16
    assert all(360 <= sum(each) <= 360 + each.count(1) for each in (mine, other))


def test_loop_in_the_physics_is_lived_by_one_and_learned_by_both(one, two, tmp_path):
    alone = copy_of(one, tmp_path / "physics", "post_train", PHYSICS)
    work(str(alone), "post_train", PHYSICS)
    assert furthest(weights(one, "post_train"), weights(alone, "post_train")) > 1e-4  # others than imagination's
    assert furthest(weights(alone, "post_train"), weights(two / "physics", "post_train")) < 1e-5
    rows = [json.loads((two / "physics" / f"rows_{rank}.json").read_text()) for rank in range(2)]
    assert all(144 <= sum(each) <= 144 + each.count(1) for each in rows)


def test_what_one_process_holds_two_hold(one, two, tmp_path):
    alone, free = (copy_of(one, tmp_path / name, "post_train", HOLDING) for name in ("held", "free"))
    work(str(alone), "post_train", HOLDING)
    work(str(free), "post_train", {"post_train": HOLDING["post_train"] | {"hold": 0.0}})
    assert furthest(weights(free, "post_train"), weights(alone, "post_train")) > 1e-4
    assert furthest(weights(alone, "post_train"), weights(two / "holding", "post_train")) < 1e-5
    held = [line["held_groups"] for line in lines(two / "holding", "post_train") if "held_groups" in line]
    assert held == [line["held_groups"] for line in lines(alone, "post_train") if "held_groups" in line]
    assert len(held) == 3 and 0 < sum(held) < 3


@pytest.mark.parametrize(
    ("kind", "update", "said"),
    [
        ("post_train", 22, "iterations continues after step"),
        ("sft", 22, "nll continues after step 1 of 5"),
        ("train_reflector", 4, "imagines held out was finished"),
    ],
)
@pytest.mark.parametrize("two", ["ddp"], indirect=True)
def test_two_processes_of_which_one_is_killed_continue_to_the_same_weights(one, two, tmp_path, kind, update, said):
    stage = STAGES[kind]
    run, often = copy_of(one, tmp_path / "run", stage), {"checkpoint_minutes": 0.0}
    struck = torchrun([{"run": str(run), "kind": kind, "settings": often, "kill": [1, update]}])
    assert struck.returncode and not (run / "checkpoints" / stage).exists()
    refused = rf"was saved by 2 processes, now 1: delete {run / 'resume' / stage} to begin the stage anew"
    with pytest.raises(SystemExit, match=refused):
        work(str(run), kind, often)
    done = torchrun([{"run": str(run), "kind": kind, "settings": often}])
    assert done.returncode == 0, done.stderr[-4000:]
    assert f"{stage}: {said}" in done.stdout
    assert furthest(weights(two / kind, stage), weights(run, stage)) == 0.0
    assert lines(two / kind, stage) == lines(run, stage)


def test_what_cannot_be_shared_is_one_line_and_ends_both(one, tmp_path):
    run = copy_of(one, tmp_path / "run", "sft", {"sft": {}})
    done = torchrun([{"run": str(run), "kind": "sft", "settings": {"sft": {"batch_size": 7}}}])
    assert done.returncode
    said = [line for line in done.stderr.splitlines() if "error:" in line]
    assert said == ["error: sft.batch_size must be a multiple of the 2 processes that share it, got 7"]


def test_an_error_that_both_meet_in_a_stage_is_told_once(one, tmp_path):
    run = copy_of(one, tmp_path / "run", "sft")
    (run / "rollouts" / "demonstrations.mcap").unlink()
    done = torchrun([{"run": str(run), "kind": "sft", "settings": {}}])
    assert done.returncode
    said = [line for line in done.stderr.splitlines() if "error:" in line]
    assert len(said) == 1 and "demonstrations.mcap does not exist: run the stage 'demonstrate'" in said[0]


@pytest.mark.parametrize(
    ("environment", "device", "said"),
    [
        ({"RANK": "0"}, "cpu", "WORLD_SIZE=2 asks for several processes, but LOCAL_RANK, MASTER_ADDR, MASTER_PORT is"),
        ({name: "0" for name in processes.NEEDED}, "cuda:1", "device must be auto, cpu or cuda, got 'cuda:1'"),
    ],
)
def test_an_environment_that_is_not_torchruns_is_refused(monkeypatch, environment, device, said):
    for name in processes.NEEDED:
        monkeypatch.delenv(name, raising=False)
    for name, value in (environment | {"WORLD_SIZE": "2"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=said):
        processes.join(device)


def test_more_processes_than_gpus_are_refused(monkeypatch):
    for name in processes.NEEDED:
        monkeypatch.setenv(name, "2")
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ValueError, match="2 processes were started on a machine of 1 GPUs: --nproc-per-node 1, or"):
        processes.join("auto")


def test_without_torchrun_nothing_is_joined(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert processes.join("cuda:3") == "cuda:3"
    assert not torch.distributed.is_initialized() and processes.size() == 1 and processes.is_main()
