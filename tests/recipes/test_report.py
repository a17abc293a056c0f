"""The report of a run folder, from whatever is in it."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest
import torch
import yaml

import film_strip
from config import GOAL_TASKS, PRESETS, SFT
from parts import make_policy, make_reflector, make_world_model
from report import Report, main
from run import write_rules
from run_folder import RunFolder
from worldenv_trl.reflectors import StopRule
from worldenv_trl.scenes.catalogue import SUITES_FOLDER


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run folder whose models have learned nothing."""
    torch.manual_seed(0)
    config = dataclasses.replace(
        PRESETS["smoke"][1],
        run_dir=tmp_path_factory.mktemp("runs") / "run",
        num_threads=1,
        tasks=GOAL_TASKS[1:2],
        max_steps=16,
        sft=SFT(dim=32, depth=1),
    )
    folder = RunFolder(config.run_dir)
    folder.open(config)
    policy = make_policy(config)
    for name in ("sft", "post_train"):
        policy.save_pretrained(folder.checkpoint(name))
    make_world_model(config).save_pretrained(folder.checkpoint("world_model"))
    make_reflector(config).save_pretrained(folder.checkpoint("reflector"))
    write_rules(folder.checkpoint("reflector"), dict.fromkeys(("real", "imagined"), StopRule()))
    folder.log("sft", step=0, l1=1.0)
    return config.run_dir


def report_of(run, **settings) -> str:
    return main(Report(run, **({"episodes_per_task": 2} | settings))).read_text()


def test_a_run_with_models_has_episodes_drift_calibration_and_tables(finished, capsys):
    page = report_of(finished)
    assert page.count("<video") >= 1 and page.count('class="strip"') == page.count("<video")
    assert "PSNR of moving pixels against the horizon" in page and "Calibration of the reflector" in page
    assert "<h3>Held-out contexts" in page and "Missing: calibration" not in page
    assert "the stage evaluate has not finished" in page  # it is said, not an error
    assert "report.html" in capsys.readouterr().out


def test_without_models_the_report_says_so(finished, tmp_path):
    page = report_of(finished, models=False, out=tmp_path / "logged.html")
    assert "<video" not in page and "--no-models" in page


def test_a_run_without_a_reflector_names_the_stage_to_run(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    shutil.rmtree(run / "checkpoints" / "reflector")
    page = report_of(run)
    assert "train_reflector" in page and "<video" not in page
    assert str(tmp_path) not in page.replace(str(run), "")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"run": "nowhere"}, "error: nowhere does not exist; give the --run-dir"),
        ({"out": "missing_folder/report.html"}, "error: the folder missing_folder does not exist"),
        ({"episodes_per_task": 0}, "episodes-per-task must be at least 1"),
    ],
)
def test_bad_input_gives_one_line(finished, settings, message, tmp_path, monkeypatch):
    from pathlib import Path

    monkeypatch.chdir(tmp_path)
    settings = {key: Path(value) if isinstance(value, str) else value for key, value in settings.items()}
    with pytest.raises(SystemExit, match=message):
        main(Report(**({"run": finished} | settings)))
    assert not list(tmp_path.iterdir())


def test_a_damaged_wave_costs_its_table_and_nothing_else(finished, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    (run / "rollouts" / "post_train_000.mcap").write_bytes(b"no rollouts at all")
    page = report_of(run, clips_per_kind=1)
    assert "<video" in page and "What LOOP learned from" not in page
    assert "warning: missing in the report: the wave post_train_000.mcap" in capsys.readouterr().out


def test_a_config_that_is_none_is_named(tmp_path):
    (tmp_path / "config.yaml").write_text("{ tasks: [")
    with pytest.raises(SystemExit, match=r"config.yaml holds no settings \(while parsing"):
        main(Report(tmp_path))


def test_a_file_is_no_run_folder_and_stays_as_it_is(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("precious")
    with pytest.raises(SystemExit, match="is no run folder"):
        main(Report(path))
    assert path.read_text() == "precious"


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("goal/open_the_drawer_of_yore", "the run's task 'goal/open_the_drawer_of_yore' is not one of this release"),
        ("goal/put_the_bowl_on_the_plate", "the models of this run do not know 'put the bowl on the plate'"),
    ],
)
def test_tasks_that_have_changed_since_are_named_with_the_remedy(finished, tmp_path, capsys, task, message):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    settings = yaml.safe_load((run / "config.yaml").read_text()) | {"tasks": [task]}
    (run / "config.yaml").write_text(yaml.safe_dump(settings))
    page = report_of(run)
    said = capsys.readouterr().out
    assert f"warning: missing in the report: {message}" in said and "--no-models" in said
    assert "<video" not in page and task in page


def test_a_task_file_that_is_not_found_from_here_is_named_with_the_folder_to_call_from(finished, tmp_path, monkeypatch):
    run, away = tmp_path / "run", tmp_path / "away"
    shutil.copytree(finished, run)
    away.mkdir()
    (tmp_path / "mine.bddl").write_text((SUITES_FOLDER / f"{GOAL_TASKS[1]}.bddl").read_text())
    settings = yaml.safe_load((run / "config.yaml").read_text()) | {"tasks": ["mine.bddl"]}
    (run / "config.yaml").write_text(yaml.safe_dump(settings))
    monkeypatch.chdir(away)
    page = report_of(run)
    assert f"there is no task file {away / 'mine.bddl'}: the run was made with &#x27;mine.bddl&#x27;; call" in page
    monkeypatch.chdir(tmp_path)
    assert "<video" in report_of(run, clips_per_kind=1)


def test_parts_of_the_users_own_are_said_to_be_passed_and_their_report_stays(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    path = run / "checkpoints" / "world_model" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"class": "MyWorldModel"}))
    (run / "report.html").write_text("of before")
    own = r"holds MyWorldModel, not VideoWorldModel.* report.write\(report.Report\(folder\), parts\); --no-models"
    with pytest.raises(SystemExit, match=own):
        main(Report(run))
    assert (run / "report.html").read_text() == "of before"
    assert "<video" not in report_of(run, models=False)


def test_the_versions_of_the_run_are_shown_beside_those_of_the_report(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    assert "<h3>Versions</h3>" in (page := report_of(run, models=False)) and "this report" not in page
    (noted,) = json.loads((run / "versions.json").read_text())
    assert {"python", "torch", "worldenv_trl", "mujoco"} <= set(noted)
    (run / "versions.json").write_text(json.dumps([noted | {"torch": "1.2.3"}, noted | {"mujoco": "2.3.4"}]))
    page = report_of(run, models=False)
    assert all(words in page for words in ("1.2.3", "2.3.4", "continued with", "this report"))
    (run / "versions.json").unlink()
    assert "did not note its versions" in report_of(run, models=False)


def test_it_says_whose_stages_a_run_began_with(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    assert "Taken over" not in report_of(run, models=False)
    (run / "begun.json").write_text(json.dumps({"run": "/of/<others>", "stages": ["demonstrate", "sft"]}))
    assert "Taken over from /of/&lt;others&gt;: demonstrate, sft." in report_of(run, models=False)


def test_a_film_strip_is_drawn_of_a_run_and_leaves_nothing_where_there_is_none(finished, tmp_path):
    film_strip.main(film_strip.Settings(finished, out=tmp_path / "new" / "strip.png", state=1, columns=2))
    assert (tmp_path / "new" / "strip.png").stat().st_size > 1000
    with pytest.raises(SystemExit, match="nosuch does not exist"):
        film_strip.main(film_strip.Settings(tmp_path / "nosuch"))
    assert not (tmp_path / "nosuch").exists()
