"""Rollouts as a LeRobot v3 folder. Neither direction needs the ``lerobot`` package."""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor

from worldenv_trl.data.lerobot_stats import episode_stats, joined_stats
from worldenv_trl.data.lerobot_video import write_video
from worldenv_trl.keys import CONTROL_HZ, INSTRUCTION, MASK, SUCCESS
from worldenv_trl.record.mcap.layout import executed_entries, leaves, to_bytes

__all__ = ["write_lerobot"]

EXTRAS = "meta/worldenv_trl.json"  # what LeRobot has no place for: exact keys, shapes and dtypes
FINAL = "meta/worldenv_trl_final.parquet"  # the observation after an episode's last action
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_FILES_PER_CHUNK, _FILE_BYTES = 1000, 100 * 2**20
_COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_Path = tuple[str, ...]


def write_lerobot(
    rollouts: TensorDictBase,
    folder: str | os.PathLike,
    *,
    video: bool = False,
    fps: int = CONTROL_HZ,
    robot_type: str = "panda",
    overwrite: bool = False,
) -> Path:
    """Writes rollouts ``[*B, T]``, one action an entry, as a LeRobot v3 dataset.

    Row t holds what was seen before action t, the action and what followed (``next.reward``, ``next.done``,
    ``next.success``). Numbers are exact. Frames are PNG images in the parquet files, or with ``video`` H.264 in RGB
    without quantisation: both without loss. What LeRobot has no place for (the observation after the last action, the
    keys and shapes of other entries) is in two files of our own below ``meta``; LeRobot ignores them.

    Args:
        rollouts: entries outside of the mask are left out; entries that are both root and next must be chained.
        folder: is written under another name and renamed when it is complete.

    Keyword Args:
        video: MP4 files instead of images.
        fps: control steps a second.
        robot_type: as in ``meta/info.json``.
        overwrite: replace an existing folder.

    Returns:
        The folder.

    Raises:
        FileExistsError: if the folder exists and ``overwrite`` is False.
        ValueError: for rollouts without images or actions, of chunks, or whose root and next values do not match.
        ImportError: naming the extra, without pyarrow (or av, for ``video``).
    """
    folder = Path(folder)
    if folder.exists() and not overwrite:
        raise FileExistsError(f"{folder} exists: pass overwrite=True to replace it")
    pa, pq = pyarrow()
    tensors, texts = leaves(rollouts)
    valid = executed_entries(rollouts)
    flat = {k: v.reshape(*valid.shape, *v.shape[rollouts.ndim :]) for k, v in tensors.items() if k != MASK}
    lengths = valid.sum(-1).tolist()
    columns = _columns(flat, valid)
    said = _instructions(texts, valid.shape)
    tasks = list(dict.fromkeys(said[row] for row, length in enumerate(lengths) if length))
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        writer = _FolderWriter(partial, columns, video, fps, pa, pq)
        for row, length in enumerate(lengths):
            if length:
                writer.add({key: value[row] for key, value in flat.items()}, length, tasks.index(said[row]), said[row])
        writer.finish(tasks, robot_type, [path for path in texts if path[-1] == INSTRUCTION])
        if folder.exists():
            old = folder.with_name(folder.name + ".old")
            os.replace(folder, old)
            os.replace(partial, folder)
            shutil.rmtree(old)
        else:
            os.replace(partial, folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return folder


def pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise ImportError("LeRobot folders need pyarrow: pip install worldenv_trl[data]") from error
    return pa, pq


def feature_name(path: _Path) -> str:
    """LeRobot's name of an entry."""
    return ".".join(path)


def _is_image(value: Tensor) -> bool:
    return value.dtype == torch.uint8 and value.ndim == 5 and value.shape[2] == 3 and min(value.shape[-2:]) >= 8


def _columns(flat: dict[_Path, Tensor], valid: Tensor) -> list[dict[str, Any]]:
    """What becomes a column: its key, name, kind, shape and dtype, and whether the next value is chained to it."""
    columns = []
    for path, value in flat.items():
        if path[0] == "next" and path[1:] in flat:
            continue
        image = _is_image(value)
        if not image and value.dtype == torch.uint8 and value.ndim > 4:
            raise ValueError(f"entry {path} holds several frames for each action: LeRobot needs one action an entry")
        after = flat.get(("next", *path))
        if after is not None:
            same = value[:, 1:].shape == after[:, :-1].shape and value.dtype == after.dtype
            inner = valid[:, 1:]
            if not same or (to_bytes(value[:, 1:][inner]) != to_bytes(after[:, :-1][inner])).any():
                raise ValueError(f"entry {path} before a step is not what it was after the one before: exclude it")
        name = feature_name(path)
        if image:
            name = "observation.images." + feature_name(path[1:] if path[0] == "observation" else path)
        columns.append(
            {
                "key": list(path),
                "name": name,
                "image": image,
                "shape": list(value.shape[2:]),
                "dtype": str(value.dtype).removeprefix("torch."),
                "chained": after is not None,
            }
        )
    if not any(c["image"] for c in columns) or not any(c["key"] == ["action"] for c in columns):
        raise ValueError("these rollouts cannot become a LeRobot dataset: it needs images and one 'action' an entry")
    return columns


def _instructions(texts: dict[_Path, Any], shape: Sequence[int]) -> list[str]:
    value = texts.get((INSTRUCTION,), "")
    if isinstance(value, str):
        return [value] * shape[0]
    words = value
    while words and isinstance(words[0], list) and isinstance(words[0][0], list):
        words = [each for part in words for each in part]
    words = words if isinstance(words[0], list) else [words]
    return [row[0] for row in words]


class _FolderWriter:
    """Files of one dataset, episode by episode."""

    def __init__(self, root: Path, columns: list[dict[str, Any]], video: bool, fps: int, pa: Any, pq: Any) -> None:
        self.root, self.columns, self.video, self.fps, self.pa, self.pq = root, columns, video, fps, pa, pq
        self.schema = self._schema()
        self.episodes: list[dict[str, Any]] = []
        self.final: list[dict[str, Any]] = []
        self.frames = self.file = 0
        self._file_bytes = 0
        self._file_frames = 0
        self._writer: Any = None
        self._videos: dict[str, list[np.ndarray]] = {}

    def _schema(self) -> Any:
        pa, fields = self.pa, []
        for column in self.columns:
            if column["image"]:
                if not self.video:
                    fields.append((column["name"], pa.struct([("bytes", pa.binary()), ("path", pa.string())])))
                continue
            kind = pa.from_numpy_dtype(stored_dtype(column["dtype"]))
            count = int(np.prod(column["shape"], dtype=np.int64))
            fields.append((column["name"], kind if count == 1 else pa.list_(kind, count)))
        for name in ("next.done", "next.success"):
            if name not in [field[0] for field in fields]:
                fields.append((name, pa.bool_()))
        counters = [("timestamp", pa.float32())] + [(name, pa.int64()) for name in _COUNTERS[1:]]
        return pa.schema(fields + counters)

    def add(self, values: dict[_Path, Tensor], length: int, task: int, said: str) -> None:
        """One episode: its entries [T, ...] by path."""
        pa = self.pa
        arrays: dict[str, Any] = {}
        stats: dict[str, dict[str, np.ndarray]] = {}
        final: dict[str, Any] = {}
        for column in self.columns:
            path, name = tuple(column["key"]), column["name"]
            value = values[path][:length]
            if column["image"]:
                frames = value.permute(0, 2, 3, 1).contiguous().numpy()
                stats[name] = episode_stats(frames, image=True)
                if self.video:
                    self._videos.setdefault(name, []).append(frames)
                else:
                    arrays[name] = [{"bytes": _png(frame), "path": None} for frame in frames]
                if column["chained"]:
                    final[name] = _png(values["next", *path][length - 1].permute(1, 2, 0).contiguous().numpy())
                continue
            flat = value.reshape(length, -1).to(getattr(torch, stored_dtype(column["dtype"]).name)).numpy()
            stats[name] = episode_stats(flat)
            arrays[name] = flat[:, 0] if flat.shape[1] == 1 else _lists(pa, flat)
            if column["chained"]:
                final[name] = to_bytes(values["next", *path][length - 1 : length]).tobytes()
        for name in ("done", SUCCESS):
            after = values.get(("next", name))
            arrays.setdefault(
                f"next.{name}",
                np.arange(1, length + 1) == length if after is None else after[:length].reshape(length).bool().numpy(),
            )
        steps = np.arange(length)
        counters: dict[str, np.ndarray] = {
            "timestamp": (steps / self.fps).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full(length, len(self.episodes)),
            "index": self.frames + steps,
            "task_index": np.full(length, task),
        }
        stats |= {name: episode_stats(value.reshape(-1, 1)) for name, value in counters.items()}
        table = pa.table({field.name: (arrays | counters)[field.name] for field in self.schema}, schema=self.schema)
        if self._writer is None or self._file_bytes > _FILE_BYTES:
            self._next_file()
        self._writer.write_table(table)
        self._file_bytes += table.nbytes
        chunk, file = divmod(self.file, _FILES_PER_CHUNK)
        episode = {
            "episode_index": len(self.episodes),
            "tasks": [said],
            "length": length,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + length,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for name in self._videos:
            episode |= {
                f"videos/{name}/chunk_index": chunk,
                f"videos/{name}/file_index": file,
                f"videos/{name}/from_timestamp": self._file_frames / self.fps,
                f"videos/{name}/to_timestamp": (self._file_frames + length) / self.fps,
            }
        episode |= {f"stats/{name}/{key}": value for name, each in stats.items() for key, value in each.items()}
        self.episodes.append(episode)
        self.final.append(final)
        self.frames += length
        self._file_frames += length

    def _next_file(self) -> None:
        if self._writer is not None:
            self._end_file()
            self.file += 1
        chunk, file = divmod(self.file, _FILES_PER_CHUNK)
        path = self.root / DATA.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = self.pq.ParquetWriter(path, self.schema, compression="snappy")
        self._file_bytes = self._file_frames = 0

    def _end_file(self) -> None:
        self._writer.close()
        chunk, file = divmod(self.file, _FILES_PER_CHUNK)
        for name, parts in self._videos.items():
            path = self.root / VIDEO.format(video_key=name, chunk_index=chunk, file_index=file)
            write_video(path, parts, self.fps)
            parts.clear()

    def finish(self, tasks: list[str], robot_type: str, said: list[_Path]) -> None:
        if not self.episodes:
            raise ValueError("the rollouts hold no executed step: there is nothing to write")
        self._end_file()
        pa, pq = self.pa, self.pq
        stats = joined_stats(self.episodes)
        meta = self.root / "meta"
        (self.root / _EPISODES).parent.mkdir(parents=True)
        rows = [{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in e.items()} for e in self.episodes]
        pq.write_table(pa.Table.from_pylist(rows), self.root / _EPISODES)
        pq.write_table(_tasks_table(pa, tasks), meta / "tasks.parquet")
        (meta / "stats.json").write_text(json.dumps(stats, indent=4))
        pq.write_table(pa.Table.from_pylist(self.final), self.root / FINAL)
        (self.root / EXTRAS).write_text(
            json.dumps({"version": 1, "columns": self.columns, "instructions": said}, indent=2)
        )
        info = {
            "codebase_version": "v3.0",
            "robot_type": robot_type,
            "total_episodes": len(self.episodes),
            "total_frames": self.frames,
            "total_tasks": len(tasks),
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": _FILE_BYTES // 2**20,
            "video_files_size_in_mb": 500,
            "fps": self.fps,
            "splits": {"train": f"0:{len(self.episodes)}"},
            "data_path": DATA,
            "video_path": VIDEO if self.video else None,
            "features": self._features(),
        }
        (meta / "info.json").write_text(json.dumps(info, indent=4))

    def _features(self) -> dict[str, Any]:
        features: dict[str, Any] = {}
        for column in self.columns:
            if column["image"]:
                _, height, width = column["shape"]
                feature: dict[str, Any] = {"dtype": "video" if self.video else "image", "shape": [height, width, 3]}
                feature["names"] = ["height", "width", "channels"]
                if self.video:
                    feature["info"] = {
                        "video.height": height,
                        "video.width": width,
                        "video.codec": "h264",
                        "video.pix_fmt": "gbrp",
                        "video.is_depth_map": False,
                        "video.fps": self.fps,
                        "video.channels": 3,
                        "has_audio": False,
                    }
            else:
                count = int(np.prod(column["shape"], dtype=np.int64))
                feature = {"dtype": stored_dtype(column["dtype"]).name, "shape": [count], "names": None}
            features[column["name"]] = feature
        for name in ("next.done", "next.success"):
            features.setdefault(name, {"dtype": "bool", "shape": [1], "names": None})
        for name in _COUNTERS:
            dtype = "float32" if name == "timestamp" else "int64"
            features[name] = {"dtype": dtype, "shape": [1], "names": None}
        return features


def stored_dtype(name: str) -> np.dtype:
    """The dtype of a column: parquet has no half precision that all readers know, float32 holds it exactly."""
    return np.dtype("float32" if name in ("bfloat16", "float16") else name)


def _lists(pa: Any, values: np.ndarray) -> Any:
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values).reshape(-1)), values.shape[1])


def _png(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def _tasks_table(pa: Any, tasks: Iterable[str]) -> Any:
    """Tasks as pandas would write a frame that has them as its index: LeRobot reads it with pandas."""
    tasks = list(tasks)
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    names = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": n, "field_name": n, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for n, kind, numpy in names
        ],
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(described)})
