"""Tasks of LIBERO's demonstration files, and where its camera stands."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("h5py")
sys.path.append(str(Path(__file__).parents[1] / "data"))

import h5py
from small_libero import BDDL, write_libero

from worldenv_trl.robot.panda import BASE_POSITION
from worldenv_trl.scenes import SceneBatch, load_task
from worldenv_trl.scenes.libero import libero_camera, libero_language


@pytest.mark.parametrize(
    ("thing", "place", "pixel"),
    [
        # Where things are in an initial state of LIBERO's (goal suite, task 8; its world, m), and in the picture that
        # it renders of it (128 px, upright), by eye.
        ("plate", (0.062, -0.009, 0.970), (62, 85)),
        ("cream cheese", (-0.046, 0.134, 0.935), (85, 77)),
        ("burner", (-0.254, 0.202, 0.930), (92, 58)),
        ("foot of the bottle", (-0.204, -0.062, 0.970), (54, 57)),
    ],
)
def test_liberos_camera_shows_things_where_liberos_pictures_do(thing, place, pixel):
    camera = libero_camera("libero_tabletop_manipulation")
    ours = np.array(place) - [-0.66, 0.0, 0.912] + BASE_POSITION
    assert np.abs(camera.project(ours, 128) - pixel).max() < 3, thing


def test_a_file_of_demonstrations_is_its_task(tmp_path):
    path = tmp_path / "put_the_bowl_on_the_plate_demo.hdf5"
    write_libero(path)
    task = load_task(str(path))
    assert task.language == "put the bowl on the plate"  # LIBERO's: of the file's name, not the BDDL's words
    assert task.goal == (("On", "akita_black_bowl_1", "plate_1"),)
    assert task.camera("agentview") == libero_camera("libero_tabletop_manipulation")
    scene = SceneBatch(task, 1, cameras=("agentview",), image_size=64)
    assert scene.model.ncam == 2 and task.init_states("train", 2).shape[0] == 2


def test_liberos_words_are_those_of_the_file_name():
    assert libero_language("x/KITCHEN_SCENE10_close_the_top_drawer_demo.hdf5") == "close the top drawer"
    assert libero_language("LIVING_ROOM_SCENE2_put_both_in_the_basket_demo.hdf5") == "put both in the basket"
    assert libero_language("open_the_middle_drawer_of_the_cabinet.hdf5") == "open the middle drawer of the cabinet"


def test_a_file_that_says_nothing_of_its_task_takes_the_bddl_beside_it(tmp_path):
    path = tmp_path / "put_it_there_demo.hdf5"
    write_libero(path, regenerated=True)
    with pytest.raises(ValueError, match=r"bddl_file_content.*put_it_there\.bddl"):
        load_task(str(path))
    (tmp_path / "put_it_there.bddl").write_text(BDDL)
    assert load_task(str(path)).language == "put it there"


def test_other_files_are_refused_by_name(tmp_path):
    path = tmp_path / "a_demo.hdf5"
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_task(str(path))
    write_libero(path, bddl=BDDL.replace("LIBERO_Tabletop_Manipulation", "bench"))
    with pytest.raises(ValueError, match=r"a_demo.hdf5 is no file of LIBERO's: \(problem bench\)"):
        load_task(str(path))
    write_libero(path, bddl=BDDL.replace("plate_1 - plate", "plate_1 - saucer"))
    with pytest.raises(ValueError, match=r"a_demo.hdf5, bddl_file_content:.*saucer"):
        load_task(str(path))
    with h5py.File(path, "w") as file:
        file["other"] = [1]
    with pytest.raises(ValueError, match="does not say what its task is"):
        load_task(str(path))
