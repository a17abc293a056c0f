"""The contact sheet holds what it promises."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from show_scenes import Sheet, main


def test_the_sheet_has_a_row_for_every_task_and_moment(tmp_path, capsys):
    main(Sheet(out=tmp_path / "deep" / "sheet.png", columns=2, image_size=32, zoom=3, moments=(0.0, 1.0)))
    sheet = np.asarray(Image.open(tmp_path / "deep" / "sheet.png"))
    assert sheet.shape == (3 * 2 * 32 * 3, 2 * 32 * 3, 3)
    assert capsys.readouterr().out.count("solved 2 of 2") == 3
    start, end = sheet[: 32 * 3], sheet[32 * 3 : 2 * 32 * 3]
    assert (start != end).any(-1).mean() > 0.05


def test_an_unknown_suite_is_named(tmp_path):
    with pytest.raises(SystemExit, match="kitchen"):
        main(Sheet(out=tmp_path / "sheet.png", suite="kitchen"))
