"""A loop that is interrupted, killed or cut short goes on as if nothing had happened."""

from __future__ import annotations

import dataclasses
import errno
import multiprocessing
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.checkpoint import CheckpointRotation

import resumable
from config import PRESETS
from resumable import NotResumable, Resumable
from run import Run
from run_folder import RunFolder

STEPS = 12


def open_run(path: Path, minutes: float = 0.0) -> Run:
    config = dataclasses.replace(PRESETS["smoke"][1], run_dir=path, checkpoint_minutes=minutes)
    folder = RunFolder(path)
    folder.open(config)
    return Run(config, folder)


def learn(run: Run, stop_before: int | None = None, wait: float = 0.0, steps: int = STEPS) -> torch.Tensor:
    """A loop with every kind of state: weights, moments, a schedule, a running mean and three random streams."""
    with run.folder.stage("sft"):
        run.seed_everything("sft")
        random.seed(0)
        np.random.seed(0)
        model = torch.nn.Linear(3, 2)
        optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 0.1, total_steps=STEPS)
        seen: dict[str, float | None] = {"mean": None}
        parts = {"model": model, "optimizer": optimizer, "schedule": schedule, "seen": seen, "nothing": None}
        for step in Resumable(run, "l1", steps, **parts):
            if step == stop_before:
                raise KeyboardInterrupt
            time.sleep(wait)
            batch = torch.randn(4, 3) + random.random() + float(np.random.rand())
            loss = model(batch).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            seen["mean"] = loss.item() if seen["mean"] is None else 0.9 * seen["mean"] + 0.1 * loss.item()
            run.folder.log("sft", step=step, **seen)
        out = torch.cat([parameter.detach().flatten() for parameter in model.parameters()])
        np.save(run.folder.path / "weights.npy", out.numpy())
    return out


def steps_logged(run: Run) -> list[dict]:
    return [line for line in run.folder.read_metrics("sft") if "step" in line]


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Final weights and metrics of a run that nothing interrupts and that saves nothing before its end."""
    run = open_run(tmp_path_factory.mktemp("straight") / "run", minutes=1000.0)
    return learn(run), steps_logged(run)


@pytest.mark.parametrize("every", [1, 5])
def test_an_interrupted_loop_ends_bit_for_bit_where_a_straight_one_does(tmp_path, straight, capsys, monkeypatch, every):
    monkeypatch.setattr(Resumable, "_due", lambda self: self.step % every == 0)
    run = open_run(tmp_path / "run")
    for stop in (3, 7, 8):
        with pytest.raises(KeyboardInterrupt):
            learn(run, stop_before=stop)
        torch.manual_seed(1)
        random.seed(1)
        np.random.seed(1)
    assert torch.equal(learn(run), straight[0])
    assert steps_logged(run) == straight[1]
    last = 8 if every == 1 else 5
    assert f"sft: l1 continues after step {last} of 12\n" in capsys.readouterr().out
    assert run.folder.done("sft") and not run.folder.progress("sft").exists()


def test_a_finished_stage_begins_anew(tmp_path, straight, capsys):
    run = open_run(tmp_path / "run")
    for _ in range(2):
        assert torch.equal(learn(run), straight[0]) and steps_logged(run) == straight[1]
    assert capsys.readouterr().out == ""


def test_a_loop_that_was_finished_in_an_unfinished_stage_is_not_run_again(tmp_path, straight, monkeypatch, capsys):
    run = open_run(tmp_path / "run", minutes=1000.0)
    monkeypatch.setattr(np, "save", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        learn(run)
    monkeypatch.undo()
    monkeypatch.setattr(torch.optim.AdamW, "step", None)
    assert torch.equal(learn(run), straight[0]) and steps_logged(run) == straight[1]
    assert capsys.readouterr().out == "sft: l1 was finished\n"


def test_the_time_that_a_killed_process_took_counts(tmp_path):
    run = open_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=4, wait=0.1)
    learn(run)
    assert run.folder.read_metrics("sft")[-1]["seconds"] >= 0.4


def checkpoints(run: Run) -> list[Path]:
    return sorted(run.folder.progress("sft").glob("*.torchrl"))


def test_the_last_two_checkpoints_are_kept(tmp_path):
    run = open_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=7)
    assert [path.name for path in checkpoints(run)] == [f"l1-{step:012d}.torchrl" for step in (6, 7)]


@pytest.mark.parametrize("damage", ["cut", "flip", "empty"])
def test_a_damaged_checkpoint_costs_a_warning_and_the_steps_since_the_one_before(tmp_path, straight, capsys, damage):
    run = open_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=7)
    newest = checkpoints(run)[-1]
    data = bytearray(newest.read_bytes())
    data[len(data) // 3] ^= 255
    newest.write_bytes({"cut": bytes(data[: len(data) // 2]), "flip": bytes(data), "empty": b""}[damage])
    assert torch.equal(learn(run), straight[0]) and steps_logged(run) == straight[1]
    told = capsys.readouterr()
    assert told.err == f"warning: {newest} is cut short or damaged: the one before it is taken, if any\n"
    assert "continues after step 6 of 12" in told.out


def test_without_a_whole_checkpoint_the_stage_begins_anew(tmp_path, straight):
    run = open_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=7)
    for path in checkpoints(run):
        path.write_bytes(path.read_bytes()[:100])
    assert torch.equal(learn(run), straight[0]) and steps_logged(run) == straight[1]


def test_what_a_process_left_that_was_killed_while_it_saved_goes(tmp_path):
    run = open_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=3)
    left = run.folder.progress("sft") / ".l1-000000000004.torchrl.stage-ab"
    left.mkdir()
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=5)
    assert not left.exists()


def test_a_full_disk_costs_a_warning_and_leaves_the_older_checkpoint(tmp_path, straight, capsys, monkeypatch):
    run, save = open_run(tmp_path / "run"), CheckpointRotation.save

    def full(self, checkpoint, *, step, **options):
        if step > 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        return save(self, checkpoint, step=step, **options)

    monkeypatch.setattr(CheckpointRotation, "save", full)
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=7)
    warnings = capsys.readouterr().err.splitlines()
    assert len(warnings) == 2 and "sft, l1: no checkpoint after step 6 ([Errno 28] No space left" in warnings[0]
    assert torch.equal(learn(run), straight[0]) and steps_logged(run) == straight[1]
    assert "continues after step 5 of 12" in capsys.readouterr().out


def test_a_disk_without_room_is_noticed_before_anything_is_written(tmp_path, capsys, monkeypatch):
    run = open_run(tmp_path / "run")
    usage = resumable.shutil.disk_usage("/")
    monkeypatch.setattr("worldenv_trl.memmap.shutil.disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(KeyboardInterrupt):
        learn(run, stop_before=2)
    assert "no checkpoint after step 1 (the checkpoint take" in capsys.readouterr().err
    assert not checkpoints(run)


def test_a_checkpoint_of_another_loop_size_or_number_of_processes_is_refused(tmp_path, monkeypatch):
    run, save = open_run(tmp_path / "run"), CheckpointRotation.save

    def loop(**parts):
        with run.folder.stage("sft"):
            for step in Resumable(run, "l1", 4, **parts):
                if step == 2:
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop(model=torch.nn.Linear(2, 2))
    remedy = f"delete {run.folder.progress('sft')} to begin the stage anew"
    with pytest.raises(NotResumable, match="is of another loop: it differs in alarm, model; delete"):
        loop(alarm=torch.nn.Linear(2, 2))
    with pytest.raises(NotResumable, match=r"size mismatch for weight.*to begin the stage anew") as refused:
        loop(model=torch.nn.Linear(3, 2))
    assert remedy in str(refused.value) and "\n" not in str(refused.value)
    assert len(checkpoints(run)) == 2
    by_two = {"metadata": {"world_size": 2}}
    monkeypatch.setattr(CheckpointRotation, "save", lambda *arguments, **options: save(*arguments, **options | by_two))
    run.folder.forget("sft")
    with pytest.raises(KeyboardInterrupt):
        loop(model=torch.nn.Linear(2, 2))
    with pytest.raises(NotResumable, match="was saved by 2 processes, now 1: delete"):
        loop(model=torch.nn.Linear(2, 2))


def test_loops_whose_names_begin_alike_keep_apart(tmp_path):
    run = open_run(tmp_path / "run")
    heads = {name: torch.nn.Linear(2, 2) for name in ("head", "head-2", "head/3")}
    with pytest.raises(KeyboardInterrupt), run.folder.stage("sft"):
        for name, head in heads.items():
            list(Resumable(run, name, 2, model=head))
        raise KeyboardInterrupt
    with run.folder.stage("sft"):
        for name, head in heads.items():
            again = torch.nn.Linear(2, 2)
            assert list(Resumable(run, name, 2, model=again)) == [] and torch.equal(again.weight, head.weight)


def test_outside_a_stage_nothing_is_saved(tmp_path):
    run = open_run(tmp_path / "run")
    assert list(Resumable(run, "l1", 3, model=torch.nn.Linear(2, 2))) == [0, 1, 2]
    assert not (run.folder.path / "resume").exists()


def work(path: Path) -> None:
    """What a process does that is killed."""
    torch.set_num_threads(1)
    learn(open_run(path), wait=0.05)


def test_a_process_killed_again_and_again_ends_bit_for_bit_where_a_straight_one_does(tmp_path, straight):
    start, draw = multiprocessing.get_context("forkserver"), random.Random(0)
    start.set_forkserver_preload(["resumable"])
    kills = 0
    while not (tmp_path / "run" / "stages" / "sft").exists():
        process = start.Process(target=work, args=(tmp_path / "run",))
        process.start()
        metrics = tmp_path / "run" / "metrics.jsonl"
        before = metrics.stat().st_mtime_ns if metrics.exists() else 0
        while kills < 4 and process.is_alive() and (not metrics.exists() or metrics.stat().st_mtime_ns == before):
            time.sleep(0.01)
        process.join(draw.uniform(0, 0.4) if kills < 4 else None)
        if process.is_alive():
            process.kill()
            process.join()
        assert process.exitcode in (0, -signal.SIGKILL)  # it may have ended just before the signal
        kills += process.exitcode == -signal.SIGKILL
    assert kills
    run = open_run(tmp_path / "run")
    assert torch.equal(torch.from_numpy(np.load(run.folder.path / "weights.npy")), straight[0])
    assert steps_logged(run) == straight[1]
