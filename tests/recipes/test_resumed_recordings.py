"""Stages that only record, killed and continued: the file and the figures of a run that nothing interrupts, byte for
byte."""

from __future__ import annotations

import dataclasses
import errno
import json
import multiprocessing
import signal
import time
from pathlib import Path

import pytest
import torch
from test_collecting import Alone

from config import GOAL_TASKS, Explore, WorldEnvConfig
from demonstrate import demonstrate
from evaluate import evaluate
from explore import explore
from parts import COMPACT
from resumable import Resumable
from run import Run
from run_folder import RunFolder
from stages import open_run, rerun
from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter, read_rollouts

WAVES = 6  # two scale factors of three


class Interrupted(Exception):
    """In the middle of a stage."""


def settings(tiny: WorldEnvConfig, **changes) -> WorldEnvConfig:
    explored = Explore(episodes_per_task=12, num_envs=4, scale_factors=(0.5, 2.0))
    config = {"tasks": GOAL_TASKS[:2], "explore": explored, "checkpoint_minutes": 0.0}
    return dataclasses.replace(tiny, **config | changes)


def opened(config: WorldEnvConfig) -> Run:
    """A run whose policy is untrained."""
    run = open_run(config)
    if not run.folder.checkpoint("sft").is_dir():
        torch.manual_seed(0)
        COMPACT.policy.make(run.config).save_pretrained(run.folder.checkpoint("sft"))
    return run


def result(run: Run, stage: str) -> tuple[bytes, list[str]]:
    """The recording of a stage and its lines of metrics but for times, taken out of the folder."""
    path = run.folder.rollouts({"demonstrate": "demonstrations"}.get(stage, stage))
    left = [each for each in path.parent.iterdir() if each != path]
    assert not left and not run.folder.progress(stage).exists()
    lines = list(map(timeless, run.folder.read_metrics(stage)))
    data = path.read_bytes()
    path.unlink()
    return data, lines


def timeless(line: dict) -> str:
    return json.dumps({name: value for name, value in line.items() if "second" not in name})


def interrupt(patch: pytest.MonkeyPatch, call: int, method: str = "write", error: BaseException | None = None):
    """Lets the so many-th call of a method of the writer end the work, when its work is done."""
    original, calls = getattr(RolloutWriter, method), []

    def counted(self, *arguments):
        calls.append(None)
        out = original(self, *arguments)
        if len(calls) == call:
            raise error or Interrupted
        return out

    patch.setattr(RolloutWriter, method, counted)


@pytest.fixture
def run(tiny, monkeypatch):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    run = opened(settings(tiny))
    yield run
    run.close()


@pytest.fixture
def straight(run):
    """What exploration leaves when nothing interrupts it."""
    rerun("explore", explore, run)
    assert len(read_rollouts(run.folder.rollouts("explore"))) == 4 * WAVES
    out = result(run, "explore")
    assert len(out[1]) == 3  # a line a factor, and how long it took
    return out


def broken_off(run: Run, monkeypatch, call: int, method: str = "write") -> None:
    with monkeypatch.context() as patch:
        interrupt(patch, call, method)
        with pytest.raises(Interrupted):
            rerun("explore", explore, run)
    torch.manual_seed(1)


def test_an_exploration_that_is_broken_off_again_and_again_ends_as_a_straight_one(run, straight, monkeypatch, capsys):
    for call in (1, 2, 2, 2, 2):  # the wave that is being written goes each time
        broken_off(run, monkeypatch, call)
    capsys.readouterr()
    rerun("explore", explore, run)
    said = capsys.readouterr().out
    assert "explore: scale_0 was finished\nexplore: scale_1 continues after step 1 of 3\n" in said
    assert result(run, "explore") == straight


@pytest.mark.parametrize("checkpoints", ["every wave", "ends of factors"])
@pytest.mark.parametrize(("method", "call"), [("write", 1), ("write", WAVES), ("close", 1)])
def test_wherever_it_is_broken_off(run, straight, monkeypatch, checkpoints, method, call):
    if checkpoints == "ends of factors":
        monkeypatch.setattr(Resumable, "_due", lambda self: False)
    if method == "close":
        monkeypatch.setattr(RolloutWriter, "__exit__", lambda self, kind, *_: self.close() if kind is None else None)
    broken_off(run, monkeypatch, call, method)
    rerun("explore", explore, run)
    assert result(run, "explore") == straight


@pytest.mark.parametrize(("kept", "warnings"), [("newest", 0), ("one before", 1), ("half", 2), ("nothing", 2)])
def test_what_is_cut_short_is_collected_again(run, straight, monkeypatch, capsys, kept, warnings):
    states, taken = [], RolloutWriter.state_dict
    with monkeypatch.context() as patch:
        patch.setattr(RolloutWriter, "state_dict", lambda self: states.append(taken(self)) or states[-1])
        broken_off(run, monkeypatch, 3)  # behind two checkpoints
    partial = run.folder.rollouts("explore").with_suffix(".partial.mcap")
    sizes = sorted({state["size"] for state in states})
    size = {"newest": sizes[-1], "one before": sizes[-1] - 1, "half": sizes[0] // 2, "nothing": 0}[kept]
    partial.write_bytes(partial.read_bytes()[:size])
    capsys.readouterr()
    rerun("explore", explore, run)
    told = [line for line in capsys.readouterr().err.replace("\r", "\n").splitlines() if line.startswith("warning")]
    assert len(told) == warnings
    lost = f"warning: what was recorded of {run.folder.rollouts('explore')} is cut short, damaged or gone"
    for line in told:
        assert f"{lost}, which scale_0-" in line
    assert result(run, "explore") == straight


def test_a_disk_that_is_full_costs_one_line_and_the_wave(run, straight, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt(patch, 5, error=OSError(errno.ENOSPC, "the disk is full"))
        with pytest.raises(SystemExit, match=r"^error: .*the disk is full.*stage explore") as told:
            rerun("explore", explore, run)
    assert "\n" not in str(told.value)
    rerun("explore", explore, run)
    assert result(run, "explore") == straight


def test_an_exploration_that_finished_begins_anew(run, straight, monkeypatch):
    writes, original = [], RolloutWriter.write
    monkeypatch.setattr(RolloutWriter, "write", lambda self, wave: writes.append(wave) or original(self, wave))
    for _ in range(2):
        rerun("explore", explore, run)
    assert len(writes) == 2 * WAVES and result(run, "explore") == straight


class Two(Alone):
    """Two workers, in this very process."""

    count = 2


def test_workers_that_collect_several_waves_at_once_go_on_with_those_that_were_not_recorded(run, monkeypatch):
    spread = dataclasses.replace(run, config=dataclasses.replace(run.config, collectors="process:2/2"))
    spread.__dict__["workers"] = Two()
    rerun("explore", explore, spread)
    straight = result(spread, "explore")
    for call in (2, 3):
        broken_off(spread, monkeypatch, call)
    spread.__dict__["workers"] = Alone()  # other workers, the same shares
    shares = dataclasses.replace(spread.config, collectors="process:1/2")
    again = dataclasses.replace(spread, config=shares)
    again.__dict__["workers"] = Alone()
    rerun("explore", explore, again)
    found = result(again, "explore")
    assert found[1] == straight[1]
    assert found[0] == straight[0]


def test_demonstrations_continue_with_the_next_task(run, monkeypatch, capsys):
    rerun("demonstrate", demonstrate, run)
    assert read_rollouts(run.folder.rollouts("demonstrations"))[keys.TASK_ID][:, 0, 0].tolist() == [0, 1]
    straight = result(run, "demonstrate")
    with monkeypatch.context() as patch:
        interrupt(patch, 2)
        with pytest.raises(Interrupted):
            rerun("demonstrate", demonstrate, run)
    capsys.readouterr()
    rerun("demonstrate", demonstrate, run)
    assert "demonstrate: tasks continues after step 1 of 2\n" in capsys.readouterr().out
    assert result(run, "demonstrate") == straight


def test_an_evaluation_continues_with_the_next_task_of_a_recording(run, monkeypatch, capsys):
    torch.manual_seed(1)
    COMPACT.policy.make(run.config).save_pretrained(run.folder.checkpoint("post_train"))
    assert list(run.config.tasks) != sorted(run.config.tasks)

    def evaluated() -> tuple[list[bytes], list[str]]:
        with run.folder.stage("evaluate"):
            evaluate(run, "sft", "post_train", None)
        names = [f"evaluate_physics_{name}.mcap" for name in ("post_train", "sft")]
        assert sorted(each.name for each in run.folder.rollouts("").parent.iterdir()) == names
        data = [(run.folder.rollouts("").parent / name).read_bytes() for name in names]
        return data, list(map(timeless, run.folder.read_metrics("evaluate")))

    straight = evaluated()
    for _ in range(3):  # a task each, of two policies
        with monkeypatch.context() as patch:
            interrupt(patch, 2)
            with pytest.raises(Interrupted):
                evaluated()
    assert "evaluate: physics post_train continues after step 1 of 2\n" not in capsys.readouterr().out
    assert evaluated() == straight
    assert "evaluate: physics post_train continues after step 1 of 2\n" in capsys.readouterr().out


def work(config: WorldEnvConfig) -> None:
    """What a process does that is killed."""
    torch.set_num_threads(1)
    rerun("explore", explore, opened(config))


def test_a_process_that_is_killed_in_the_middle_of_exploration(tiny):
    config, start = settings(tiny), multiprocessing.get_context("forkserver")
    start.set_forkserver_preload(["explore"])
    folder, results = RunFolder(config.run_dir), []
    for kills in (0, 2):
        moments = []
        while not folder.rollouts("explore").exists() or not folder.done("explore"):
            process = start.Process(target=work, args=(config,))
            process.start()
            had = checkpoints(folder)
            while len(moments) < kills and process.is_alive() and len(checkpoints(folder) - had) < 2:
                time.sleep(0.005)
            if len(moments) < kills and process.is_alive():
                process.kill()
                moments.append(len(checkpoints(folder)))
            process.join()
            assert process.exitcode in (0, -signal.SIGKILL)
        assert bool(moments) == bool(kills)
        results.append(result(Run(config, folder), "explore"))
        folder.forget("explore")
    assert results[0] == results[1]


def checkpoints(folder: RunFolder) -> set[Path]:
    return set(folder.progress("explore").glob("*.torchrl"))
