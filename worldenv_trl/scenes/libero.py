"""Tasks of LIBERO's demonstration files: their scenes in our own objects, seen from where LIBERO's camera stands."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from worldenv_trl.hdf5_file import open_hdf5, text_of
from worldenv_trl.robot import WRIST, Camera
from worldenv_trl.robot.panda import BASE_POSITION
from worldenv_trl.scenes.bddl import Problem, parse_bddl, read_bddl
from worldenv_trl.scenes.files import FileTask, task_of

__all__ = ["libero_camera", "libero_language", "load_libero"]

_ABOVE = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
_BESIDE = (0.6182166934013367, 0.3432307541370392, 0.3432314395904541, 0.6182177066802979)
# Of each class of problems in LIBERO's world: the robot's base (m), agentview (m) and how it is turned (w, x, y, z).
_PLACES = {
    "libero_tabletop_manipulation": ((-0.66, 0.0, 0.912), (0.6586131746834771, 0.0, 1.6103500240372423), _ABOVE),
    "libero_kitchen_tabletop_manipulation": (
        (-0.66, 0.0, 0.912), (0.6586131746834771, 0.0, 1.6103500240372423), _ABOVE,
    ),
    "libero_study_tabletop_manipulation": ((-0.75, 0.0, 0.912), (0.4586131746834771, 0.0, 1.6103500240372423), _ABOVE),
    "libero_living_room_tabletop_manipulation": ((-0.51, 0.0, 0.42), (0.6065773716836134, 0.0, 0.96), _BESIDE),
    "libero_floor_manipulation": ((-0.6, 0.0, 0.0), (0.8965773716836134, 5.216182733499864e-07, 0.65), _BESIDE),
}  # fmt: skip
_FIELD_OF_VIEW = 45.0


def libero_camera(kind: str) -> Camera:
    """``agentview`` of a class of LIBERO's problems, placed as far from our robot's base as it is from LIBERO's.

    Raises:
        ValueError: for a class that is not LIBERO's.
    """
    if kind not in _PLACES:
        raise ValueError(f"(problem {kind}) is none of LIBERO's classes, {', '.join(_PLACES)}")
    base, position, (w, x, y, z) = _PLACES[kind]
    rotation = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    moved = np.subtract(position, base) + BASE_POSITION
    return Camera("agentview", tuple(moved.tolist()), rotation, _FIELD_OF_VIEW)


def libero_language(path: str | os.PathLike) -> str:
    """What LIBERO's benchmark tells a policy: the file's name in words, without ``KITCHEN_SCENE3`` and the like.

    Examples:
        >>> libero_language("data/KITCHEN_SCENE3_turn_on_the_stove_demo.hdf5")
        'turn on the stove'
    """
    stem = Path(path).stem.removesuffix("_demo")
    return re.sub(r"^[A-Z_]+_SCENE\d+_", "", stem).replace("_", " ")


def load_libero(path: str | os.PathLike) -> FileTask:
    """The task of a file of LIBERO's demonstrations, ``<task>_demo.hdf5``.

    The scene is what the file's BDDL says, in this package's objects and colours; ``agentview`` is LIBERO's, so that
    the hand is at the same pixels in the file's images and in the scene's.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: without h5py.
        ValueError: if it holds no BDDL and none is beside it, or one that is not LIBERO's.
    """
    path = Path(path)
    problem = _problem(path)
    try:
        camera = libero_camera(problem.kind)
    except ValueError as error:
        raise ValueError(f"{path} is no file of LIBERO's: {error}") from error
    return task_of(problem, name=str(path), suite="libero", language=libero_language(path), cameras=(camera, WRIST))


def _problem(path: Path) -> Problem:
    with open_hdf5(path) as file:
        text = text_of(file["data"].attrs.get("bddl_file_content", "")) if "data" in file else ""
    if isinstance(text, str) and "(define" in text:
        return parse_bddl(text, f"{path}, bddl_file_content")
    beside = path.with_name(path.stem.removesuffix("_demo") + ".bddl")
    if not beside.is_file():
        raise ValueError(
            f"{path} does not say what its task is (attribute bddl_file_content): put LIBERO's file {beside.name} of "
            f"bddl_files/ beside it"
        )
    return read_bddl(beside)
