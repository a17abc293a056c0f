"""MCAP back to rollouts."""

from __future__ import annotations

import glob
import json
import os
import warnings
from pathlib import Path
from typing import Any

import torch
from mcap.records import Attachment, Channel, Message, Metadata
from tensordict import NonTensorData, NonTensorStack, TensorDict
from torch import Tensor

from worldenv_trl.keys import MASK, TASK_ID
from worldenv_trl.record.layout import Layout
from worldenv_trl.record.part import Part
from worldenv_trl.record.scan import Truncated, scan
from worldenv_trl.record.writer import FORMAT, PARTIAL_SUFFIX, VERSION

__all__ = ["read_attachments", "read_metadata", "read_rollouts"]

_Path = tuple[str, ...]


def read_rollouts(path: str | os.PathLike, *, task: str | None = None) -> TensorDict:
    """The rollouts that :class:`RolloutWriter` wrote to a file, to all files of a folder or to those of a glob.

    Keys, dtypes and the values where ``("collector", "mask")`` is True are those that were written, bit for bit; the
    rest is zero. Several writes or files are concatenated along the first dimension and padded to the longest (batch
    dimensions are flattened where they differ behind the first). Where no rollout is shorter than the others, root and
    next values that were stored once share memory: clone them before writing in place.

    A file that was cut off gives every step that is complete, with a warning. Files of a folder that are still being
    written (``*.partial.mcap``) are left out.

    Args:
        path: file, folder (its ``*.mcap``, by name) or pattern.

    Keyword Args:
        task: only rollouts of this task.

    Returns:
        TensorDict [*B, T].

    Raises:
        FileNotFoundError: if there is no such file, or none in the folder.
        ValueError: for a file that is no MCAP, damaged or not written by :class:`RolloutWriter`; for files whose
            entries differ; if ``task`` is not in the files.
    """
    files = _files(path)
    parts: list[Part] = []
    metadata: dict[str, Any] = {}
    for file in files:
        found, described = _read_file(file)
        if task is not None:
            _require_task(file, described, task)
        parts += found
        metadata = described
    if not parts:
        raise ValueError(f"{path} holds no rollouts")
    rollouts = _join(parts, path)
    if task is None or (len(_tasks(metadata)) == 1 and len(files) == 1):
        return rollouts
    return _of_task(rollouts, task, path)


def read_metadata(path: str | os.PathLike) -> dict[str, Any]:
    """The ``metadata`` that a file's :class:`RolloutWriter` was given. Raises as :func:`read_rollouts`."""
    return _described(_require_file(path))[0]


def read_attachments(path: str | os.PathLike) -> dict[str, bytes]:
    """The attachments of a file, by name. Raises as :func:`read_rollouts`."""
    return _described(_require_file(path))[1]


# ------------------------------------------------------------------------------------------------- files


def _files(path: str | os.PathLike) -> list[Path]:
    target = Path(path)
    if target.is_dir():
        found = sorted(p for p in target.glob("*.mcap") if not p.name.endswith(PARTIAL_SUFFIX))
        if not found:
            raise FileNotFoundError(f"there is no .mcap file in the folder {target}: record rollouts into it first")
        return found
    if target.exists():
        return [target]
    if glob.has_magic(str(path)):
        found = sorted(Path(p) for p in glob.glob(str(path)) if not p.endswith(PARTIAL_SUFFIX))
        if not found:
            raise FileNotFoundError(f"no file matches {path}")
        return found
    return [_require_file(target)]


def _require_file(path: str | os.PathLike) -> Path:
    path = Path(path)
    if path.is_file():
        return path
    partial = path.with_name(path.stem + PARTIAL_SUFFIX)
    hint = f"; an unfinished recording is in {partial}" if partial.exists() else ""
    raise FileNotFoundError(f"there is no file {path}{hint}")


def _read_file(path: Path) -> tuple[list[Part], dict[str, Any]]:
    """The writes of a file and its metadata; warns if it was cut off."""
    layouts: list[Layout] = []
    parts: list[Part] = []
    metadata: dict[str, Any] = {}
    topics: dict[int, str] = {}
    known = truncated = False
    try:
        for record in scan(path):
            if isinstance(record, Message):
                if parts:
                    topic = topics.get(record.channel_id, "")
                    parts[-1].messages.setdefault(topic, []).append(record.data)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata) and record.name == FORMAT:
                known = True
                _check_version(path, record.metadata)
            elif isinstance(record, Metadata) and record.name == "metadata":
                metadata = _plain(path, record.metadata)
            elif isinstance(record, Metadata) and record.name == f"{FORMAT}.layout":
                layouts.append(_described_layout(path, record.metadata))
            elif isinstance(record, Metadata) and record.name == f"{FORMAT}.write":
                if parts:
                    parts[-1].decode(complete=True)
                parts.append(_described_write(path, record.metadata, layouts))
    except Truncated:
        truncated = True
    if not known:
        raise ValueError(f"{path} holds no worldenv_trl rollouts: it was written by another program")
    if parts:
        expected = sum(parts[-1].lengths)
        parts[-1].decode(complete=not truncated)
        if truncated:
            done = sum(part.done for part in parts)
            missing = expected - parts[-1].done
            warnings.warn(
                f"{path} is truncated: {done} complete steps were read, at least {missing} more are missing",
                stacklevel=3,
            )
    return [part for part in parts if part.rows], metadata


def _described(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    metadata, attachments, known = {}, {}, False
    try:
        for record in scan(path):
            if isinstance(record, Metadata) and record.name == FORMAT:
                known = True
            elif isinstance(record, Metadata) and record.name == "metadata":
                metadata = _plain(path, record.metadata)
            elif isinstance(record, Attachment):
                attachments[record.name] = record.data
            elif isinstance(record, Channel | Message):
                break  # both come before the first message
    except Truncated:
        pass
    if not known:
        raise ValueError(f"{path} holds no worldenv_trl rollouts: it was written by another program")
    return metadata, attachments


def _check_version(path: Path, values: dict[str, str]) -> None:
    version = int(values.get("version", "0"))
    if not 1 <= version <= VERSION:
        raise ValueError(
            f"{path} has format version {version}, this release reads up to {VERSION}: update worldenv_trl"
        )


def _plain(path: Path, values: dict[str, str]) -> dict[str, Any]:
    try:
        return {key: json.loads(value) for key, value in values.items()}
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} holds no worldenv_trl rollouts: its metadata is not JSON ({error})") from error


def _described_layout(path: Path, values: dict[str, str]) -> Layout:
    try:
        return Layout.from_json(json.loads(values["json"]))
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} describes its entries in a way this release does not know: {error!r}") from error


def _described_write(path: Path, values: dict[str, str], layouts: list[Layout]) -> Part:
    try:
        record = json.loads(values["json"])
        index = record["layout"]
        return Part(
            layout=layouts[index],
            prefix=f"/layout_{index + 1}" if index else "",
            batch=record["batch"],
            steps=record["steps"],
            lengths=record["lengths"],
            texts=[(tuple(key), words) for key, words in record["texts"]],
            executed=record.get("executed"),
            file=path,
        )
    except (json.JSONDecodeError, KeyError, IndexError, TypeError) as error:
        raise ValueError(f"{path} describes its rollouts in a way this release does not know: {error!r}") from error


# ------------------------------------------------------------------------------------------------- joining


def _join(parts: list[Part], path: str | os.PathLike) -> TensorDict:
    """All writes as one TensorDict [*B, T]."""
    steps = max(part.steps for part in parts)
    lengths = torch.tensor([length for part in parts for length in part.lengths])
    mask = torch.arange(steps) < lengths.unsqueeze(-1)
    whole = bool(mask.all())  # nobody is shorter: nothing has to be blanked
    out = TensorDict(batch_size=[len(lengths), steps])
    expanded = [_expanded(part) for part in parts]
    names = [set(each) for each in expanded]
    for part, have in zip(parts[1:], names[1:], strict=True):
        if have != names[0]:
            raise ValueError(
                f"{part.file} and {parts[0].file} hold different entries "
                f"({sorted(map(str, have ^ names[0]))}): read them one by one"
            )
    for key in list(expanded[0]):
        values = [each.pop(key) for each in expanded]
        if len({(value.dtype, value.shape[2:]) for value in values}) > 1:
            shapes = sorted({str((value.dtype, *value.shape[2:])) for value in values})
            raise ValueError(f"entry {key[1:]} in {path} differs between recordings: {', '.join(shapes)}")
        extra = int(key[0] == "chained")
        value = values[0] if len(values) == 1 else torch.cat([_lengthened(v, steps + extra) for v in values])
        del values
        if not extra:
            out[key[1:] if key[0] == "root" else ("next", *key[1:])] = value
        elif whole:
            out[key[1:]], out[("next", *key[1:])] = value[:, :-1], value[:, 1:]
        else:
            keep = mask.view(*mask.shape, *[1] * (value.ndim - 2))
            out[key[1:]], out[("next", *key[1:])] = value[:, :-1] * keep, value[:, 1:].clone()
    out[MASK] = mask
    for index, (text, _) in enumerate(parts[0].texts):
        words = [word for part in parts for word in part.texts[index][1]]
        out[text] = _text_entry(words, steps)
    batches = [part.batch for part in parts]
    if len(parts) == 1 and not batches[0]:
        return out[0]
    tails = {tuple(batch[1:]) for batch in batches}
    tail = tails.pop() if len(tails) == 1 else ()
    return out.reshape(-1, *tail, steps) if tail else out


def _expanded(part: Part) -> dict[_Path, Tensor]:
    """The values of a part by ("root" | "next" | "chained", *key)."""
    return {(key[0] if key[0] in ("root", "next") else "chained", *key[1:]): v for key, v in part.values.items()}


def _lengthened(value: Tensor, steps: int) -> Tensor:
    missing = steps - value.shape[1]
    return value if not missing else torch.cat([value, value.new_zeros(len(value), missing, *value.shape[2:])], 1)


def _text_entry(words: list[str], steps: int) -> NonTensorData | NonTensorStack:
    if len(set(words)) == 1:
        return NonTensorData(words[0], batch_size=[len(words), steps])
    return NonTensorStack(*(NonTensorData(word, batch_size=[steps]) for word in words))


# ------------------------------------------------------------------------------------------------- tasks


def _tasks(metadata: dict[str, Any]) -> list[str]:
    named = metadata.get("tasks", metadata.get("task", []))
    return [named] if isinstance(named, str) else list(named)


def _require_task(path: Path, metadata: dict[str, Any], task: str) -> None:
    tasks = _tasks(metadata)
    if not tasks:
        raise ValueError(f"{path} does not say of which tasks it is: record it with metadata={{'tasks': [...]}}")
    if task not in tasks:
        raise ValueError(f"{path} is of {', '.join(tasks)}, not of {task}")


def _of_task(rollouts: TensorDict, task: str, path: str | os.PathLike) -> TensorDict:
    from worldenv_trl.scenes import load_task  # builds on MuJoCo; reading alone does not need it

    if TASK_ID not in rollouts.keys():  # noqa: SIM118 - a TensorDict iterates over rows
        raise ValueError(f"{path} holds several tasks and no {TASK_ID!r}: its rollouts of {task} cannot be told apart")
    chosen = rollouts[TASK_ID][..., 0, 0] == load_task(task).task_id
    if not bool(chosen.any()):
        raise ValueError(f"{path} holds no rollout of {task}")
    return rollouts[chosen] if chosen.ndim == 1 else rollouts.reshape(-1, rollouts.shape[-1])[chosen.flatten()]
