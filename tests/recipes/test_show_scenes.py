"""The contact sheet holds what it promises."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from show_scenes import Sheet, main


def test_the_sheet_has_a_row_for_every_task_and_moment(tmp_path, capsys):
    out = tmp_path / "deep" / "sheet.png"
    main(Sheet(out=out, suite="starter", columns=2, image_size=32, zoom=3, moments=(0.0, 1.0)))
    sheet = np.asarray(Image.open(out))
    assert sheet.shape == (3 * 2 * 32 * 3, 2 * 32 * 3, 3)
    assert capsys.readouterr().out.count("solved 2 of 2") == 3
    start, end = sheet[: 32 * 3], sheet[32 * 3 : 2 * 32 * 3]
    assert (start != end).any(-1).mean() > 0.05


def test_a_folder_of_files_shows_their_initial_states(tmp_path):
    (tmp_path / "one.bddl").write_text(
        """(define (problem tabletop) (:domain robosuite) (:language look at the mug)
             (:regions (spot (:target table_1) (:ranges ((-0.1 -0.1 0.1 0.1))))
                       (there (:target table_1) (:ranges ((-0.1 0.2 0.1 0.3)))))
             (:fixtures table_1 - table) (:objects mug_1 - red_coffee_mug)
             (:init (On mug_1 table_1_spot)) (:goal (On mug_1 table_1_there)))"""
    )
    main(Sheet(out=tmp_path / "sheet.png", suite=str(tmp_path), columns=3, image_size=32, zoom=1))
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape == (32, 3 * 32, 3)
    assert (sheet[:, :32] != sheet[:, 32:64]).any()


def test_an_unknown_suite_is_named(tmp_path):
    with pytest.raises(SystemExit, match="kitchen"):
        main(Sheet(out=tmp_path / "sheet.png", suite="kitchen"))
