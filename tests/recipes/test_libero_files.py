"""LIBERO's demonstration files as the tasks of a run."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("h5py")
sys.path.append(str(Path(__file__).parents[1] / "data"))

import h5py
from small_libero import BDDL, write_libero

import config
import dry_run
import world_env
from run_folder import RunFolder
from stages import open_run, plan, rerun
from worldenv_trl import keys
from worldenv_trl.record import read_metadata, read_rollouts
from worldenv_trl.scenes.libero import libero_camera


@pytest.fixture
def suite(tmp_path):
    folder = tmp_path / "libero_goal"
    folder.mkdir()
    write_libero(folder / "put_the_bowl_on_the_plate_demo.hdf5", (14, 11, 9), size=64, failed=(1,), still=(2,))
    other = BDDL.replace("0.04 -0.03 0.06 -0.01", "0.10 0.10 0.12 0.12")
    write_libero(folder / "bring_the_bowl_demo.hdf5", (10, 13), size=64, seed=1, bddl=other)
    return folder


@pytest.fixture
def settings(tiny, suite):
    return dataclasses.replace(
        tiny,
        device="cpu",
        tasks=(str(suite),),
        cameras=("agentview", "wrist"),
        demonstrate=config.Demonstrate(episodes_per_task=2),
        sft=config.SFT(steps=12, scale_steps=2, batch_size=16),
        explore=config.Explore(episodes_per_task=4, num_envs=4, scale_factors=(1.0,)),
    )


def test_the_whole_loop_runs_on_liberos_demonstrations(settings, suite):
    world_env.run_all(settings)
    folder = RunFolder(settings.run_dir)
    path = folder.rollouts("demonstrations")
    told = read_rollouts(path)
    assert told[:, 0][keys.TASK_ID].flatten().tolist() == [0, 0, 1, 1]  # by name: bring, put
    assert told[keys.MASK].sum(-1).tolist() == [9, 12, 12, 7]  # the failure and the no-ops are gone
    assert [told[row, 0].get(keys.INSTRUCTION).tolist() for row in (0, 2)] == [
        "bring the bowl",
        "put the bowl on the plate",
    ]
    seen = read_metadata(path)["calibration"][str(suite / "bring_the_bowl_demo.hdf5")]["agentview"]
    assert seen["position"] == pytest.approx(libero_camera("libero_tabletop_manipulation").position)
    lines = [line for line in folder.read_metrics() if line["stage"] == "sft" and "l1" in line]
    assert lines[-1]["l1"] < lines[0]["l1"]
    logged = [line for line in folder.read_metrics() if line["stage"] == "demonstrate" and "strayed_m" in line]
    assert [line["steps"] for line in logged] == [10.5, 9.5] and max(line["strayed_m"] for line in logged) < 0.01
    assert (folder.path / "report.html").exists() and folder.done("evaluate")


def test_commands_for_liberos_controller_end_with_sft(settings, capsys):
    stored = dataclasses.replace(settings, demonstrate=config.Demonstrate(2, actions="stored"))
    world_env.run_all(stored)
    assert "its actions are for LIBERO's controller" in capsys.readouterr().out
    folder = RunFolder(settings.run_dir)
    assert folder.done("sft") and not folder.path.joinpath("rollouts/explore.mcap").exists()
    told = read_rollouts(folder.rollouts("demonstrations"))
    # Uniform in [-1, 1] in the file; what the hand does is a tenth of it.
    assert told[keys.ACTION][told[keys.MASK]][:, :3].abs().mean() > 0.4
    ours = dataclasses.replace(stored, tasks=config.GOAL_TASKS)
    assert [stage.kind for stage in plan(ours)][-1] == "evaluate"


def test_the_same_settings_convert_to_the_same_bits(settings, tmp_path):
    made = []
    for name in ("one", "two"):
        run = open_run(dataclasses.replace(settings, run_dir=tmp_path / name))
        rerun("demonstrate", world_env.demonstrate, run)
        made.append(read_rollouts(run.folder.rollouts("demonstrations")))
    for key in (keys.IMAGE, keys.ACTION, keys.STATE, keys.KINEMATIC_STATE):
        assert torch.equal(made[0][key], made[1][key])


def test_where_the_expert_would_begin_is_not_read(settings):
    spread = config.Demonstrate(2, states="spread")
    run = open_run(dataclasses.replace(settings, demonstrate=spread, train_states=1))
    rerun("demonstrate", world_env.demonstrate, run)
    assert len(read_rollouts(run.folder.rollouts("demonstrations"))) == 2 * len(run.config.tasks)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"image_size": 128}, r"holds images of 64 px, the run's are of 128: --image-size 64"),
        ({"cameras": ("agentview", "front")}, "--cameras agentview wrist"),
        ({"max_steps": 8}, "a demonstration of 12 steps, max_steps is 8: --max-steps 16 or more"),
        ({"demonstrate": config.Demonstrate(3)}, r"holds 2 demonstrations.*--demonstrate.episodes-per-task 2"),
        ({"demonstrate": config.Demonstrate(2, actions="delta")}, "must be one of path, stored, got 'delta'"),
    ],
)
def test_settings_that_do_not_suit_the_files_are_one_line(settings, changed, said):
    with pytest.raises(SystemExit, match=said):
        open_run(dataclasses.replace(settings, **changed))
    assert not (settings.run_dir / "rollouts").exists()


def test_files_that_do_not_suit_the_run_are_one_line(settings, suite, tmp_path):
    mixed = dataclasses.replace(settings, tasks=(*settings.tasks, config.GOAL_TASKS[0]))
    with pytest.raises(SystemExit, match="all or none: starter/put_the_bowl_on_the_plate is none"):
        open_run(mixed)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match=r"the folder .*empty, which holds no file of LIBERO's"):
        open_run(dataclasses.replace(settings, tasks=(str(tmp_path / "empty"),)))
    with h5py.File(suite / "bring_the_bowl_demo.hdf5", "a") as file:
        del file["data/demo_1/obs/joint_states"]
    with pytest.raises(SystemExit, match=r"bring_the_bowl_demo.hdf5:demo_1 lacks 'obs/joint_states'"):
        open_run(settings)
    write_libero(suite / "bring_the_bowl_demo.hdf5", (), size=64)
    with pytest.raises(SystemExit, match=r"bring_the_bowl_demo.hdf5 holds no demonstrations"):
        open_run(settings)


def test_a_dry_run_counts_the_files(settings, capsys):
    chosen, _ = dry_run.split(["--dry-run", "--gpu", "H100"])
    assert dry_run.dry_run(settings, chosen) == 0
    printed = capsys.readouterr().out
    assert "demonstrations: 4 of 2 files of LIBERO's, 40 steps (1 failures and 2 no-ops left out)" in printed
    assert "demonstrations: 88 frames of agentview, wrist at 64 px, 0.00 GB" in printed
