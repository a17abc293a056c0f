"""HDF5 files of robomimic and LIBERO: opening them, and what their groups are called."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["SUFFIXES", "demonstration_names", "demonstrations_of", "open_hdf5", "text_of"]

SUFFIXES = (".hdf5", ".h5")


def open_hdf5(path: str | os.PathLike) -> Any:
    """The file, open for reading.

    Raises:
        ImportError: without h5py, saying how to get it.
        FileNotFoundError: if there is no such file.
        ValueError: for a file that is no HDF5.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError("HDF5 files need h5py: pip install worldenv_trl[data]") from error
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path} is not a readable HDF5 file: {error}") from error


def demonstrations_of(file: Any, path: str | os.PathLike) -> Any:
    """The group ``data``; raises ``ValueError`` if it holds no demonstration."""
    if "data" not in file or not demonstration_names(file["data"]):
        raise ValueError(f"{path} holds no demonstrations: a robomimic or LIBERO file has groups data/demo_0, ...")
    return file["data"]


def demonstration_names(data: Any) -> list[str]:
    """``demo_0``, ``demo_1``, ... by number."""
    found = [name for name in data if re.fullmatch(r"demo_\d+", name)]
    return sorted(found, key=lambda name: int(name[5:]))


def text_of(value: Any) -> Any:
    """An attribute as text or plain Python."""
    if isinstance(value, bytes):
        return value.decode()
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
