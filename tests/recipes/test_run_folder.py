"""Run folders: resuming, and what happens when something goes wrong."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest

import run_folder
from config import PRESETS, SFT
from run_folder import RunFolder


@pytest.fixture
def config(tmp_path):
    return dataclasses.replace(PRESETS["smoke"][1], run_dir=tmp_path / "run")


@pytest.fixture
def folder(config):
    folder = RunFolder(config.run_dir)
    folder.open(config)
    return folder


def test_a_stage_that_raises_is_not_finished_and_its_metrics_go_when_it_runs_again(folder):
    folder.log("explore", success=0.5)
    with pytest.raises(KeyboardInterrupt), folder.stage("sft"):
        folder.log("sft", step=0, l1=1.0)
        raise KeyboardInterrupt
    assert not folder.done("sft")
    with folder.stage("sft"):
        folder.log("sft", step=0, l1=2.0)
    assert folder.done("sft")
    assert [item["l1"] for item in folder.read_metrics("sft") if "l1" in item] == [2.0]
    assert folder.read_metrics("explore") == [{"stage": "explore", "success": 0.5}]


def test_the_same_settings_continue_a_run_and_others_are_refused_by_name(config, folder):
    folder.open(config)
    folder.open(dataclasses.replace(config, num_threads=1))  # where it runs is no setting of the result
    with pytest.raises(ValueError, match=r"sft.steps=800, now 7: use another --run-dir"):
        folder.open(dataclasses.replace(config, sft=dataclasses.replace(config.sft, steps=7)))
    assert SFT().steps != 7


def test_a_setting_that_is_newer_than_the_folder_counts_as_its_default(tmp_path):
    config = dataclasses.replace(PRESETS["smoke"][1], run_dir=tmp_path / "run")
    folder = RunFolder(config.run_dir)
    folder.open(config)
    stored = folder.path / "config.yaml"
    stored.write_text("".join(line for line in stored.read_text().splitlines(True) if "shift_px" not in line))
    folder.open(config)
    assert "shift_px: 2" in stored.read_text()
    stored.write_text("".join(line for line in stored.read_text().splitlines(True) if "shift_px" not in line))
    with pytest.raises(ValueError, match=r"sft.shift_px=2, now 3: use another --run-dir"):
        folder.open(dataclasses.replace(config, sft=dataclasses.replace(config.sft, shift_px=3)))


def test_a_setting_that_is_gone_and_was_on_is_refused_and_kept_by_name(config, folder):
    stored = folder.path / "config.yaml"
    stored.write_text(stored.read_text() + "mixed: 0\n")
    folder.open(config)  # it did nothing
    idle = stored.read_text().replace("post_train:\n", "post_train:\n  held_share: 1.0\n")
    stored.write_text(idle)
    folder.open(config)  # nor did this at what was its default
    stored.write_text(idle.replace("held_share: 1.0", "held_share: 0.25"))
    with pytest.raises(ValueError, match=r"made with post_train.held_share=0.25, which is no setting any more"):
        folder.open(config)
    stored.write_text(idle.replace("  held_share: 1.0\n", ""))
    stored.write_text(stored.read_text() + "mixed: 0.5\n")
    with pytest.raises(ValueError, match=r"made with mixed=0.5, which is no setting any more: use another --run-dir"):
        folder.open(dataclasses.replace(config, seed=9))  # and before what could be set as it was
    assert "mixed: 0.5" in stored.read_text()


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    path = tmp_path / "file"
    path.write_text("precious")
    with pytest.raises(NotADirectoryError, match="choose another --run-dir"):
        RunFolder(path)
    assert path.read_text() == "precious"


def test_too_little_disk_is_refused_before_anything_is_written(config, monkeypatch):
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10_000_000))
    with pytest.raises(OSError, match=r"0\.01 GB free"):
        RunFolder(config.run_dir).open(config)
    assert not (config.run_dir / "config.yaml").exists()


def test_missing_inputs_name_the_stage_that_makes_them(folder):
    with pytest.raises(FileNotFoundError, match="run the stage 'sft'"):
        folder.require_checkpoint("sft", "sft")
    with pytest.raises(FileNotFoundError, match="run the stage 'explore'"):
        folder.require_rollouts("explore", "explore")


def test_versions_are_noted_once_and_again_when_they_change(config, monkeypatch):
    for version in ("2.13.0", "2.13.0", "2.14.0"):
        monkeypatch.setattr(run_folder, "machine_versions", lambda version=version: {"torch": version})
        RunFolder(config.run_dir).open(config)
    assert json.loads((config.run_dir / "versions.json").read_text()) == [{"torch": "2.13.0"}, {"torch": "2.14.0"}]


def test_a_task_that_has_changed_since_is_named(tmp_path):
    folder, config = RunFolder(tmp_path / "run"), PRESETS["smoke"][1]
    folder.open(config, {"a.bddl": "1", "b.bddl": "2"})
    folder.open(config, {"a.bddl": "1", "b.bddl": "2"})
    with pytest.raises(ValueError, match=r"b.bddl has changed since .* was made: use another --run-dir"):
        folder.open(config, {"a.bddl": "1", "b.bddl": "3"})


@pytest.mark.parametrize("name", ["config.yaml", "tasks.json"])
@pytest.mark.parametrize("text", ["", "[1, 2", "just words", "\x00\x01"])
def test_a_damaged_file_is_named_with_the_remedy_and_left(tmp_path, name, text):
    folder = RunFolder(tmp_path / "run")
    folder.open(PRESETS["smoke"][1], {"task": "digest"})
    (folder.path / name).write_text(text)
    with pytest.raises(ValueError, match=rf"{name} cannot be read \(.*\): restore it from a copy, or use another"):
        RunFolder(folder.path).open(PRESETS["smoke"][1], {"task": "digest"})
    assert (folder.path / name).read_text() == text


def test_lines_that_are_no_figures_are_left_out(folder):
    folder.log("sft", loss=1.0)
    with folder.metrics_path.open("a") as file:
        file.write('[1]\n"sft"\n{"loss": 2.0}\n{"stage": "sft", "lo')
    assert [line["loss"] for line in folder.read_metrics()] == [1.0]
