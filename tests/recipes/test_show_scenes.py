"""The contact sheet holds what it promises."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import show_scenes
from show_scenes import Sheet, main

MUG = """(define (problem tabletop) (:domain robosuite) (:language move the mug)
           (:regions (spot (:target table_1) (:ranges ((-0.1 -0.1 0.1 0.1))))
                     (there (:target table_1) (:ranges ((-0.1 0.2 0.1 0.3)))))
           (:fixtures table_1 - table) (:objects mug_1 - red_coffee_mug)
           (:init (On mug_1 table_1_spot)) (:goal (On mug_1 table_1_there)))"""


def test_the_sheet_has_a_row_for_every_task_and_moment(tmp_path, capsys):
    out = tmp_path / "deep" / "sheet.png"
    main(Sheet(out=out, suite="starter", columns=2, image_size=32, zoom=3, moments=(0.0, 1.0)))
    sheet = np.asarray(Image.open(out))
    assert sheet.shape == (3 * 2 * 32 * 3, 2 * 32 * 3, 3)
    assert capsys.readouterr().out.count("solved 2 of 2") == 3
    start, end = sheet[: 32 * 3], sheet[32 * 3 : 2 * 32 * 3]
    assert (start != end).any(-1).mean() > 0.05


@pytest.fixture
def folder(tmp_path) -> Path:
    """Files with a script, without one, and with an error in it."""
    files = tmp_path / "files"
    files.mkdir()
    (files / "1_mug.bddl").write_text(MUG)
    cookies = MUG.replace("- red_coffee_mug", "- cookies plate_1 - plate").replace(
        "mug_1 table_1_there", "mug_1 plate_1"
    )
    cookies = cookies.replace("(:init", "(:init (On plate_1 table_1_there)")  # too broad for the fingers
    (files / "2_cookies.bddl").write_text(cookies)
    (files / "3_typo.bddl").write_text(MUG.replace("(:init", "(:innit"))
    return files


def test_a_folder_of_files_shows_the_initial_states_where_there_is_no_script(folder, tmp_path, capsys):
    (folder / "3_typo.bddl").unlink()
    main(Sheet(out=tmp_path / "sheet.png", suite=str(folder), columns=2, image_size=32, zoom=1, moments=(0.0, 1.0)))
    assert np.asarray(Image.open(tmp_path / "sheet.png")).shape == ((2 + 1) * 32, 2 * 32, 3)
    out = capsys.readouterr().out
    assert "2_cookies.bddl: initial states alone: no script for" in out and "1_mug.bddl: the expert solved" in out


def test_moments_of_zero_show_initial_states_without_the_expert(folder, tmp_path, capsys):
    (folder / "3_typo.bddl").unlink()
    main(Sheet(out=tmp_path / "sheet.png", suite=str(folder), columns=3, image_size=32, zoom=1, moments=(0.0,)))
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape == (2 * 32, 3 * 32, 3)
    assert (sheet[:, :32] != sheet[:, 32:64]).any()
    assert "expert" not in capsys.readouterr().out


def test_a_file_that_cannot_be_read_is_named_and_the_rest_is_shown(folder, tmp_path, capsys):
    with pytest.raises(SystemExit, match="1 of 3 tasks are not shown"):
        main(Sheet(out=tmp_path / "sheet.png", suite=str(folder), columns=2, image_size=32, zoom=1, moments=(0.0,)))
    assert np.asarray(Image.open(tmp_path / "sheet.png")).shape == (2 * 32, 2 * 32, 3)
    errors = capsys.readouterr().err
    assert "3_typo.bddl is not shown" in errors and "':innit': unknown block: did you mean ':init'" in errors


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"columns": 0}, "--columns must be at least 1, got 0"),
        ({"zoom": 0}, "--zoom must be at least 1, got 0"),
        ({"image_size": 0}, "--image-size must be at least 16, got 0"),
        ({"camera": "front"}, "unknown --camera 'front': it must be one of agentview, wrist"),
        ({"split": "val"}, "unknown --split 'val': it must be one of train, test"),
        ({"moments": (0.0, 2.0)}, "--moments must be shares of an episode, each from 0 to 1, got 0.0 2.0"),
        ({"moments": ()}, "--moments .* got nothing"),
        (
            {"suite": "kitchen"},
            "unknown --suite 'kitchen': it must be one of spatial, object, goal, long, starter, or a",
        ),
        ({"suite": "{here}"}, "the folder .* holds no .bddl file"),
        ({"suite": "{here}/one.bddl"}, "--suite .*one.bddl is a file: name the folder"),
        ({"out": Path("sheet.xyz")}, "--out must be the name of an image such as scenes.png, got sheet.xyz"),
        ({"out": Path("sheet")}, "--out must be the name of an image"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_line_before_any_work(settings, message, tmp_path, monkeypatch):
    monkeypatch.setattr(show_scenes, "task_rows", lambda *_: pytest.fail("work was done"))
    if "one.bddl" in settings.get("suite", ""):
        (tmp_path / "one.bddl").write_text(MUG)
    if "suite" in settings:
        settings = {"suite": settings["suite"].format(here=tmp_path)}
    with pytest.raises(SystemExit, match=f"^error: {message}"):
        main(Sheet(**({"out": tmp_path / "sheet.png"} | settings)))


def test_the_command_line_says_it_without_a_traceback():
    recipe = Path(show_scenes.__file__)
    done = subprocess.run([sys.executable, recipe, "--columns", "0"], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.splitlines()[-1] == "error: --columns must be at least 1, got 0"
    assert "Traceback" not in done.stderr
