"""Every stage with a loop, interrupted and continued, against a run that nothing interrupts: bit for bit."""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch
from small_run import SMALL

import config
from post_train import post_train
from resumable import Resumable
from run import Run
from run_folder import RunFolder
from stages import open_run, plan, rerun, run_stages
from world_env import WORKS
from worldenv_trl import keys
from worldenv_trl.data import imagine
from worldenv_trl.record import read_rollouts
from worldenv_trl.reflectors import PathReflector

SETTINGS = dataclasses.replace(
    SMALL,
    checkpoint_minutes=1000.0,
    sft=config.SFT(steps=4, scale_steps=3, batch_size=8),
    world_model=config.WorldModel(steps=4, batch_size=2),
    reflector=config.Reflector(encoder_frames=24, prefixes=24, batch_size=4),
    adapt=config.Adapt(steps=4, episodes_per_task=4, batch_size=4),
    post_train=config.PostTrain(
        iterations=3,
        groups=2,
        group_size=2,
        epochs=1,
        probe_every=1,
        probe_contexts=2,
    ),
)


class Interrupted(Exception):
    """In the middle of a step."""


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """The folder of a run that nothing interrupts and whose loops save nothing before their ends."""
    path = tmp_path_factory.mktemp("straight") / "run"
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
        run_stages(open_run(dataclasses.replace(SETTINGS, run_dir=path)), WORKS)
    torch.set_num_threads(threads)
    return path


def copy_of(straight: Path, path: Path, **changes) -> Run:
    """The run in another folder, opened for other settings."""
    shutil.copytree(straight, path)
    settings, folder = dataclasses.replace(SETTINGS, run_dir=path, **changes), RunFolder(path)
    (path / "config.yaml").unlink()
    folder.open(settings)
    return Run(settings, folder)


def break_at(monkeypatch, name: str, call: int) -> None:
    """Lets the so many-th call of ``name`` fail."""
    module, _, attribute = name.rpartition(".")
    owner = functools.reduce(getattr, module.split(".")[1:], __import__(module.split(".")[0]))
    original, calls = getattr(owner, attribute), []

    def counted(*arguments, **options):
        calls.append(None)
        if len(calls) == call:
            raise Interrupted
        return original(*arguments, **options)

    monkeypatch.setattr(owner, attribute, counted)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def metrics(folder: RunFolder, stage: str) -> list[str]:
    """Every line of a stage as text, but for times."""
    lines = folder.read_metrics(stage)
    return [json.dumps({name: value for name, value in line.items() if "second" not in name}) for line in lines]


@pytest.mark.parametrize(
    ("kind", "name", "call", "said"),
    [
        ("sft", "torch.Tensor.backward", 4, "sft: l1 continues after step 2 of 4"),
        ("sft", "torch.Tensor.backward", 7, "sft: nll continues after step 2 of 3"),
        ("train_world_model", "torch.Tensor.backward", 4, "world_model: steps continues after step 2 of 4"),
        ("train_world_model", "train_world_model.fidelity", 1, "world_model: steps was finished"),
        ("train_reflector", "train_reflector.learn", 1, "reflector: imagines held out was finished"),
        ("train_reflector", "torch.Tensor.backward", 3, "reflector: 0_encoder continues after step 2 of 3"),
        ("train_reflector", "torch.Tensor.backward", 6, "reflector: 1_head continues after step 2 of 3"),
        ("adapt", "adapt.Decisions.refer", 1, "adapted: imagines explored was finished"),
        ("adapt", "torch.Tensor.backward", 4, "adapted: steps continues after step 2 of 4"),
        ("post_train", "post_train.rloo_advantage", 3, "post_train: iterations continues after step 2 of 3"),
        ("evaluate", "evaluate.physics_outcomes", 4, "evaluate: policies continues after step 3 of 4"),
    ],
)
def test_a_stage_continues_to_the_same_weights_and_metrics(
    straight, tmp_path, monkeypatch, capsys, kind, name, call, said
):
    run = copy_of(straight, tmp_path / "run")
    stage = next(stage for stage in plan(run.config) if stage.kind == kind)
    shutil.rmtree(run.folder.checkpoint(stage.name), ignore_errors=True)
    with monkeypatch.context() as patch:
        patch.setattr(Resumable, "_due", lambda self: not self._minutes or self.step % 2 == 0)
        break_at(patch, name, call)
        with pytest.raises(Interrupted):
            rerun(kind, WORKS[kind], run)
    torch.manual_seed(1)
    capsys.readouterr()
    rerun(kind, WORKS[kind], run)
    assert f"{said}\n" in capsys.readouterr().out
    assert metrics(run.folder, stage.name) == metrics(RunFolder(straight), stage.name)
    expected = files(straight / "checkpoints" / stage.name)
    assert files(run.folder.checkpoint(stage.name)) == expected and bool(expected) == (kind != "evaluate")
    for recording in straight.glob(f"rollouts/{stage.name}_*.mcap"):
        waves = [read_rollouts(path / "rollouts" / recording.name) for path in (straight, run.folder.path)]
        for key in (keys.CHUNK, ("next", keys.STEP_MASK), keys.CONTEXT_ID, ("next", *keys.IMAGE)):
            if waves[0].get(key, None) is not None:
                assert torch.equal(waves[0][key], waves[1][key])
    left = {path.name for path in run.folder.path.iterdir()} - {path.name for path in straight.iterdir()}
    assert left == set() and not list((run.folder.path / "resume").iterdir())


@pytest.mark.parametrize("lost", [False, True])
def test_imagined_episodes_continue_batch_by_batch(straight, tmp_path, monkeypatch, capsys, lost):
    runs = [copy_of(straight, tmp_path / name, checkpoint_minutes=0.0) for name in ("straight", "broken")]
    painted, paint, most = [], imagine._imagine, [100]

    def painting(*given):
        if len(painted) == most[0]:
            raise Interrupted
        painted.append(given[4].tolist())
        return paint(*given)

    monkeypatch.setattr(imagine, "_imagine", painting)
    monkeypatch.setattr("imagining.imagine_episodes", partial(imagine.imagine_episodes, rows_at_once=2))
    rerun("train_reflector", WORKS["train_reflector"], runs[0])
    whole = painted.copy()
    assert whole == [[0, 1], [2, 3], [4, 5], [0, 1]]  # for training, and held out
    painted.clear()
    for done in (1, 2, 3):
        most[0] = done
        with pytest.raises(Interrupted):
            rerun("train_reflector", WORKS["train_reflector"], runs[1])
        if lost and done == 2:
            (frames,) = runs[1].folder.progress("reflector").glob("files_0/training/**/image.memmap")
            frames.write_bytes(b"")
        torch.manual_seed(1)
    most[0] = 100
    told = (
        capsys.readouterr().err.replace("\r", "\n").count("are cut short, damaged or gone, which imagines%20training")
    )
    assert told == (2 if lost else 0)
    rerun("train_reflector", WORKS["train_reflector"], runs[1])
    assert painted == (whole[:2] + whole if lost else whole)
    results = [files(run.folder.checkpoint("reflector")) for run in runs]
    assert results[0] == results[1] and metrics(runs[0].folder, "reflector") == metrics(runs[1].folder, "reflector")
    assert not list((runs[1].folder.path / "resume").iterdir())


def test_loop_of_the_heads_in_the_physics_continues_to_the_same_weights(straight, tmp_path, monkeypatch):
    learned = dataclasses.replace(SETTINGS.post_train, env="tabletop", probe_every=2, lora_rank=0, lora_lr=0.0)

    def returns_of(wave):  # that differ: untrained actions all fail, and teach nothing
        return wave[keys.CHUNK][:, :, 0].mean((-2, -1))

    def loop(run):
        with run.folder.stage("post_train"):
            post_train(run, "sft", "post_train", "", returns_of=returns_of)

    runs = [copy_of(straight, tmp_path / name, post_train=learned) for name in ("straight", "broken")]
    for run in runs:
        run.folder.forget("post_train")
        shutil.rmtree(run.folder.checkpoint("post_train"))
    loop(runs[0])
    with monkeypatch.context() as patch:
        patch.setattr(Resumable, "_due", lambda self: True)
        break_at(patch, "post_train.rloo_advantage", 3)
        with pytest.raises(Interrupted):
            loop(runs[1])
    torch.manual_seed(1)
    loop(runs[1])
    weights = [files(run.folder.checkpoint("post_train")) for run in runs]
    assert weights[0] == weights[1] and weights[0] != files(straight / "checkpoints" / "post_train")
    assert metrics(runs[0].folder, "post_train") == metrics(runs[1].folder, "post_train")
    before, after = (runs[0].policy(name).state_dict() for name in ("sft", "post_train"))
    moved = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert moved == {"loc_head", "follow_head", "scale_head"}


def test_an_earlier_stage_that_runs_again_takes_the_checkpoints_of_the_later_ones(straight, tmp_path, monkeypatch):
    run = copy_of(straight, tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(Resumable, "_due", lambda self: True)
        break_at(patch, "post_train.rloo_advantage", 3)
        with pytest.raises(Interrupted):
            rerun("post_train", WORKS["post_train"], run)
    assert list(run.folder.progress("post_train").iterdir())
    rerun("sft", WORKS["sft"], run)
    assert not run.folder.progress("post_train").exists()


def test_a_judge_of_paths_learns_without_imagined_episodes_continues_and_rewards_imagination(
    straight, tmp_path, monkeypatch, capsys
):
    judged = dataclasses.replace(SETTINGS.reflector, path_epochs=20.0)
    runs = [copy_of(straight, tmp_path / name, reflector=judged) for name in ("straight", "broken")]
    monkeypatch.delattr("imagining.imagine_episodes")
    rerun("train_reflector", WORKS["train_reflector"], runs[0])
    with monkeypatch.context() as patch:
        patch.setattr(Resumable, "_due", lambda self: self.step % 2 == 0)
        break_at(patch, "torch.Tensor.backward", 9)
        with pytest.raises(Interrupted):
            rerun("train_reflector", WORKS["train_reflector"], runs[1])
    torch.manual_seed(1)
    rerun("train_reflector", WORKS["train_reflector"], runs[1])
    assert "reflector: 2_paths continues after step 2 of 3\n" in capsys.readouterr().out
    weights = [files(run.folder.checkpoint("reflector")) for run in runs]
    assert weights[0] == weights[1]
    rewards, judge = [], PathReflector.extend
    monkeypatch.setattr(PathReflector, "extend", lambda *given: rewards.append(out := judge(*given)) or out)
    rerun("post_train", WORKS["post_train"], runs[0])
    assert rewards
    assert files(runs[0].folder.checkpoint("post_train")) != files(straight / "checkpoints" / "post_train")
