"""A LeRobot v3 folder as rollouts."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tensordict import NonTensorData, NonTensorStack, TensorDict
from torch import Tensor

from worldenv_trl.data.lerobot import EXTRAS, FINAL, pyarrow
from worldenv_trl.data.lerobot_video import read_video
from worldenv_trl.keys import INSTRUCTION, MASK

__all__ = ["read_lerobot"]

_COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_Path = tuple[str, ...]


def read_lerobot(folder: str | os.PathLike, *, episodes: Sequence[int] | None = None) -> TensorDict:
    """The episodes of a LeRobot v3 dataset as rollouts [R, T], padded to the longest.

    A folder of :func:`~worldenv_trl.data.write_lerobot` gives its rollouts back, bit for bit. In others,
    ``observation.images.<camera>`` becomes ``("observation", <camera>)`` (the first camera ``("observation",
    "image")``, if there is none of that name), ``observation.state``, ``action`` and ``next.reward`` the entries of
    those names, and every other column ``a.b`` the entry ``("a", "b")``. An observation is repeated behind an
    episode's last action: LeRobot keeps none there.

    Args:
        folder: with ``meta/info.json``.

    Keyword Args:
        episodes: only these.

    Raises:
        FileNotFoundError: if the folder, or a file that it names, does not exist.
        ValueError: for another version of the format, an episode that is not there, or frames that are missing.
    """
    folder = Path(folder)
    _, pq = pyarrow()
    info = _info(folder)
    rows = sorted(_rows(pq, folder / "meta" / "episodes"), key=lambda row: row["episode_index"])
    if episodes is not None:
        known = {row["episode_index"]: row for row in rows}
        beyond = [index for index in episodes if index not in known]
        if beyond:
            raise ValueError(f"{folder} holds the episodes 0 to {len(rows) - 1}, not {beyond[0]}")
        rows = [known[index] for index in episodes]
    if not rows:
        raise ValueError(f"{folder} holds no episodes")
    columns = _columns(folder, info)
    out = _tensors(folder, info, rows, columns, pq)
    lengths = torch.tensor([row["length"] for row in rows])
    steps = int(lengths.max())
    out[MASK] = torch.arange(steps) < lengths.unsqueeze(-1)
    words = [(row.get("tasks") or [""])[0] for row in rows]
    for path in _instructions(folder):
        each = [NonTensorData(word, batch_size=[steps]) for word in words]
        same = len(set(words)) == 1
        out.set(path, NonTensorData(words[0], batch_size=[len(words), steps]) if same else NonTensorStack(*each))
    return out


def _info(folder: Path) -> dict[str, Any]:
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} is no LeRobot dataset: it has no meta/info.json")
    try:
        info = json.loads(path.read_text())
        version = str(info["codebase_version"])
        if missing := [name for name in ("features", "fps", "data_path") if name not in info]:
            raise KeyError(missing[0])
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} does not describe a LeRobot dataset: {error!r}") from error
    if not version.startswith("v3."):
        raise ValueError(
            f"{folder} has LeRobot format {version}, v3.0 is read: convert it with lerobot's convert_dataset_v21_to_v30"
        )
    return info


def _rows(pq: Any, folder: Path) -> Iterator[dict[str, Any]]:
    files = sorted(folder.glob("*/*.parquet"))
    if not files:
        raise FileNotFoundError(f"there are no parquet files below {folder}")
    for file in files:
        names = [name for name in pq.read_schema(file).names if not name.startswith("stats/")]
        yield from pq.read_table(file, columns=names).to_pylist()


def _instructions(folder: Path) -> list[tuple[str, ...]]:
    """The entries that held the task in words when we wrote the folder."""
    extras = folder / EXTRAS
    noted = json.loads(extras.read_text()).get("instructions") if extras.is_file() else None
    return [(INSTRUCTION,)] if noted is None else [tuple(path) for path in noted]


def _columns(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """What becomes which entry: as we noted it, or from the features of another program's dataset."""
    extras = folder / EXTRAS
    if extras.is_file():
        return json.loads(extras.read_text())["columns"]
    cameras = [name for name, feature in info["features"].items() if feature["dtype"] in ("image", "video")]
    short = {name: name.removeprefix("observation.").removeprefix("images.").replace(".", "_") for name in cameras}
    if cameras and "image" not in short.values():
        short[cameras[0]] = "image"
    columns = []
    for name, feature in info["features"].items():
        if name in _COUNTERS or feature["dtype"] == "string":
            continue
        key = ("observation", short[name]) if name in short else tuple(name.split("."))
        shape = list(feature["shape"])
        columns.append(
            {
                "key": list(key),
                "name": name,
                "image": name in short,
                "shape": shape,
                "dtype": feature["dtype"],
                "chained": key[0] == "observation",
            }
        )
    return columns


def _tensors(
    folder: Path, info: dict[str, Any], rows: list[dict[str, Any]], columns: list[dict[str, Any]], pq: Any
) -> TensorDict:
    steps = max(row["length"] for row in rows)
    out = TensorDict(batch_size=[len(rows), steps])
    final = pq.read_table(folder / FINAL).to_pylist() if (folder / FINAL).is_file() else None
    for column in columns:
        video = column["image"] and info["features"][column["name"]]["dtype"] == "video"
        read = _video_frames if video else _column_values
        whole: Tensor | None = None
        for place, value in enumerate(read(folder, info, rows, column, pq)):
            if whole is None:
                whole = value.new_zeros(len(rows), steps + 1, *value.shape[1:])
            length = rows[place]["length"]
            whole[place, :length] = value
            if column["chained"]:
                ended = None if final is None else final[rows[place]["episode_index"]].get(column["name"])
                whole[place, length] = value[-1] if ended is None else _final_value(ended, column)
        assert whole is not None  # there is at least one row
        key = tuple(column["key"])
        out[key] = whole[:, :-1].clone()
        if column["chained"]:
            out["next", *key] = whole[:, 1:].clone()
            for place, row in enumerate(rows):
                out[key][place, row["length"] :] = 0
                out["next", *key][place, row["length"] :] = 0
    return out


def _column_values(
    folder: Path, info: dict[str, Any], rows: list[dict[str, Any]], column: dict[str, Any], pq: Any
) -> Iterator[Tensor]:
    """Values [T, ...] of each episode."""
    name, opened = column["name"], {}
    for row in rows:
        path = folder / info["data_path"].format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        if path not in opened:
            if not path.is_file():
                raise FileNotFoundError(f"{folder} lacks {path.relative_to(folder)}")
            opened = {path: pq.read_table(path, columns=[name, "episode_index"])}
        table = opened[path]
        mine = table.column("episode_index").to_numpy() == row["episode_index"]
        values = table.column(name).combine_chunks().take(np.flatnonzero(mine))
        if len(values) != row["length"]:
            raise ValueError(
                f"{folder}: episode {row['episode_index']} has {row['length']} steps and {len(values)} rows"
            )
        if column["image"]:
            frames = np.stack(
                [np.asarray(Image.open(io.BytesIO(v["bytes"])).convert("RGB")) for v in values.to_pylist()]
            )
            yield torch.from_numpy(frames).permute(0, 3, 1, 2)
            continue
        flat = values
        while hasattr(flat, "flatten") and str(flat.type).startswith(("fixed_size_list", "list", "extension")):
            flat = flat.storage if str(flat.type).startswith("extension") else flat.flatten()
        array = np.asarray(flat.to_numpy(zero_copy_only=False))
        shape = column["shape"] if column["key"] and column["shape"] is not None else [-1]
        tensor = torch.from_numpy(array.copy()).reshape(len(values), *shape)
        yield tensor.to(getattr(torch, column["dtype"]))


def _video_frames(
    folder: Path, info: dict[str, Any], rows: list[dict[str, Any]], column: dict[str, Any], pq: Any
) -> Iterator[Tensor]:
    """Frames [T, 3, H, W] of each episode."""
    name, open_path, place = column["name"], None, 0
    frames: Iterator[np.ndarray] = iter(())
    for row in rows:
        path = folder / info["video_path"].format(
            video_key=name,
            chunk_index=row[f"videos/{name}/chunk_index"],
            file_index=row[f"videos/{name}/file_index"],
        )
        first = round(row[f"videos/{name}/from_timestamp"] * info["fps"])
        if path != open_path or first < place:
            if not path.is_file():
                raise FileNotFoundError(f"{folder} lacks {path.relative_to(folder)}")
            open_path, frames, place = path, read_video(path), 0
        shown: list[np.ndarray] = []
        while place < first + row["length"] and (frame := next(frames, None)) is not None:
            if place >= first:
                shown.append(frame)
            place += 1
        if len(shown) != row["length"]:
            raise ValueError(
                f"{path} holds {len(shown)} of the {row['length']} frames of episode {row['episode_index']}"
            )
        yield torch.from_numpy(np.stack(shown)).permute(0, 3, 1, 2)


def _pixels(data: bytes) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(data)).convert("RGB"))


def _final_value(ended: bytes, column: dict[str, Any]) -> Tensor:
    if column["image"]:
        return torch.from_numpy(_pixels(ended)).permute(2, 0, 1)
    values = torch.frombuffer(bytearray(ended), dtype=getattr(torch, column["dtype"]))
    return values.reshape(column["shape"])
