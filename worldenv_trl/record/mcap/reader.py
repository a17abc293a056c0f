"""MCAP back to rollouts."""

from __future__ import annotations

import difflib
import glob
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict
from torch import Tensor

from worldenv_trl.keys import EPISODE, MASK, ROW, SIM_STATE, TASK_ID
from worldenv_trl.record.mcap.arguments import check_arguments
from worldenv_trl.record.mcap.file import PARTIAL_SUFFIX, REPAIRED_SUFFIX
from worldenv_trl.record.mcap.part import Part
from worldenv_trl.record.mcap.recording import TEXT, Recording, RolloutInfo
from worldenv_trl.record.mcap.tasks import task_names, task_numbers

__all__ = ["list_rollouts", "read_attachments", "read_metadata", "read_rollouts"]

_Path = tuple[str, ...]
_Key = str | tuple[str, ...]


def read_rollouts(
    path: str | os.PathLike,
    *,
    task: str | None = None,
    rollouts: int | slice | Sequence[int] | None = None,
    time: tuple[float, float] | None = None,
    steps: slice | None = None,
    keys: Sequence[_Key] | None = None,
    replays: bool = False,
) -> TensorDict:
    """The rollouts that were recorded into a file, all files of a folder or those of a glob.

    Keys, dtypes and the values where ``("collector", "mask")`` is True are those that were written, bit for bit; the
    rest is zero. Several writes or files are concatenated along the first dimension and padded to the longest, as is
    ``sim_state`` (batch dimensions are flattened where they differ behind the first). Where no rollout is shorter than
    the others, root and next values that were stored once share memory: clone them before writing in place.

    A file that was cut off or damaged gives, with a warning, of every rollout the steps before the first one that is
    lost. Of a folder are left out: files that are still being written (``*.partial.mcap``), damaged ones whose repaired
    version lies beside them, and replays, which would count a rollout twice; a pattern or a name reads them.

    Args:
        path: file, folder (its ``*.mcap``, by name) or pattern.

    Keyword Args:
        task: only rollouts of this task, by its name in the metadata of each file.
        rollouts: only these, counted through all files; they come in the order of the files, each once.
        time: only rollouts that play between these seconds of their file, as a viewer's time line shows them.
        steps: only this part of each rollout.
        keys: only these entries, named as in the TensorDict; the others are not decoded. The name of a nest, such as
            ``"frames"``, is all in it.
        replays: of a folder, also what :func:`~worldenv_trl.record.replay` has written (``replay`` in its metadata).

    Returns:
        TensorDict [*B, T]; [R, T] when rollouts are chosen.

    Raises:
        FileNotFoundError: if there is no such file, or none in the folder.
        TypeError: if an argument is of another kind.
        ValueError: for a file that is no MCAP, without messages that it should hold, or not written by this package
            or by a later release of it; for files whose entries differ; if ``task``, a rollout, a key or any of the
            ``steps`` is not in them.
    """
    if rollouts is not None and hasattr(rollouts, "tolist"):  # arrays and tensors
        rollouts = rollouts.tolist()
    check_arguments(path, task, rollouts, time, steps, keys)
    recordings = _recordings(path, replays)
    if task is not None:
        for recording in recordings:
            _require_task(recording.path, recording.metadata, task)
    chosen = _chosen(recordings, rollouts, path)
    parts: list[Part] = []
    for number, recording in enumerate(recordings):
        task_id = None if task is None else _task_id(recording, task)
        keep = _keep(None if chosen is None else chosen[number], time)
        if chosen is None or chosen[number]:
            found = _read(recording, keep, _wanted(keys, task_id is not None))
            parts += found if task_id is None else _of_task(found, task_id, recording.path)
    if not parts:
        lost = [recording.warning([], 0) for recording in recordings if not recording.scan.intact]
        asked = f" of {task}" if task is not None else "" if rollouts is time is None else " that were asked for"
        raise ValueError(f"{path} holds no rollouts{asked}{': ' + lost[0] if lost else ''}")
    out = _join(parts, path)
    if steps is not None:
        out = _part_of(out, steps, path)
    return out if keys is None else _selected(out, keys, recordings, path)


def list_rollouts(path: str | os.PathLike, *, replays: bool = False) -> list[RolloutInfo]:
    """What each rollout is: file, number, time, entries, instruction, row. Frames are not decoded.

    Raises and warns as :func:`read_rollouts`.
    """
    check_arguments(path)
    infos: list[RolloutInfo] = []
    for recording in _recordings(path, replays):
        infos += recording.infos(_read(recording, None, lambda key: key in ((ROW,), (EPISODE,))))
    return infos


def read_metadata(path: str | os.PathLike) -> dict[str, Any]:
    """The ``metadata`` that a file was recorded with. Raises as :func:`read_rollouts`."""
    check_arguments(path)
    return Recording(_require_file(path)).metadata


def read_attachments(path: str | os.PathLike) -> dict[str, bytes]:
    """The attachments of a file, by name. Raises as :func:`read_rollouts`."""
    check_arguments(path)
    return {each.name: each.data for each in Recording(_require_file(path)).scan.attachments}


# ------------------------------------------------------------------------------------------------- selecting


def _part_of(rollouts: TensorDict, steps: slice, path: str | os.PathLike) -> TensorDict:
    part = rollouts[..., steps]
    if not part.shape[-1]:
        raise ValueError(
            f"steps={steps} chooses none: the longest rollout asked for of {path} has {rollouts.shape[-1]} steps"
        )
    return part


def _read(recording: Recording, keep: Callable | None, wanted: Callable[[_Path], bool]) -> list[Part]:
    expected = recording.expected(keep)
    parts = recording.parts(keep, wanted)
    if not parts:
        return []
    said = recording.warning(parts, expected)
    if said:
        warnings.warn(said, stacklevel=4)
    return parts


def _wanted(keys: Sequence[_Key] | None, task_id: bool) -> Callable[[_Path], bool]:
    if keys is None:
        return lambda _: True
    paths = {_path(key)[1:] if _path(key)[0] == "next" else _path(key) for key in keys}
    paths |= {(TASK_ID,)} if task_id else set()
    return lambda path: any(path[:length] in paths for length in range(1, len(path) + 1))


def _path(key: _Key) -> _Path:
    return (key,) if isinstance(key, str) else tuple(key)


def _chosen(
    recordings: list[Recording], rollouts: int | slice | Sequence[int] | None, path: object
) -> list[set[int]] | None:
    """The numbers of the chosen rollouts within each file."""
    if rollouts is None:
        return None
    counts = [recording.count() for recording in recordings]
    if not sum(counts):
        return [set() for _ in recordings]
    if isinstance(rollouts, slice):
        numbers = list(range(*rollouts.indices(sum(counts))))
    else:
        numbers = [rollouts] if isinstance(rollouts, int) else list(rollouts)
    beyond = [number for number in numbers if not 0 <= number < sum(counts)]
    if beyond:
        raise ValueError(f"{path} holds the rollouts 0 to {sum(counts) - 1}, not {beyond[0]}")
    firsts = [sum(counts[:i]) for i in range(len(counts))]
    return [
        {number - first for number in numbers if first <= number < first + count}
        for first, count in zip(firsts, counts, strict=True)
    ]


def _keep(numbers: set[int] | None, time: tuple[float, float] | None) -> Callable[[int, int, int], bool] | None:
    if numbers is None and time is None:
        return None
    first, last = (-1.0, float("inf")) if time is None else time

    def keep(number: int, start: int, end: int) -> bool:
        return (numbers is None or number in numbers) and start <= last * 1e9 and end >= first * 1e9

    return keep


def _selected(rollouts: TensorDict, keys: Sequence[_Key], recordings: list[Recording], path: object) -> TensorDict:
    have = set(rollouts.keys(True))
    missing = [key for key in keys if (_path(key)[0] if len(_path(key)) == 1 else _path(key)) not in have]
    if missing:
        known = {"/".join(each): each[0] if len(each) == 1 else each for r in recordings for each in r.entries()}
        close = difflib.get_close_matches("/".join(_path(missing[0])), known, n=3)
        hint = f"did you mean {' or '.join(repr(known[name]) for name in close)}? It" if close else "it"
        raise ValueError(
            f"{path} holds no entry {missing[0]!r}: {hint} has {', '.join(sorted(map(repr, known.values())))}"
        )
    return rollouts.select(*keys, MASK)


# ------------------------------------------------------------------------------------------------- files


def _recordings(path: str | os.PathLike, replays: bool) -> list[Recording]:
    found = [Recording(file) for file in _files(path)]
    if replays or not Path(path).is_dir():
        return found
    kept = [recording for recording in found if "replay" not in recording.metadata]
    if not kept:
        raise FileNotFoundError(f"the folder {path} holds nothing but replays: pass replays=True to read them")
    return kept


def _files(path: str | os.PathLike) -> list[Path]:
    target = Path(path)
    if target.is_dir():
        found = sorted(p for p in target.glob("*.mcap") if not p.name.endswith(PARTIAL_SUFFIX))
        found = [p for p in found if not p.with_name(f"{p.stem}{REPAIRED_SUFFIX}").exists()]
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
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name one recording")
    partial = path.with_name(path.stem + PARTIAL_SUFFIX)
    hint = f"; an unfinished recording is in {partial}" if partial.exists() else ""
    raise FileNotFoundError(f"there is no file {path}{hint}")


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
                f"({', '.join(sorted('/'.join(key[1:]) for key in have ^ names[0]))}): read them one by one, or "
                "name the entries that both hold with keys=[...]"
            )
    for key in list(expanded[0]):
        if key == ("root", TEXT):
            continue
        values = [each.pop(key) for each in expanded]
        if key[1:] == (SIM_STATE,):  # as the env does with those of several tasks: zeros up to the longest
            width = max(value.shape[-1] for value in values)
            values = [torch.nn.functional.pad(value, (0, width - value.shape[-1])) for value in values]
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


def _require_task(path: Path, metadata: dict[str, Any], task: str) -> None:
    tasks = task_names(metadata)
    if not tasks:
        raise ValueError(f"{path} does not say of which tasks it is: record it with metadata={{'tasks': [...]}}")
    if task not in tasks:
        raise ValueError(f"{path} is of {', '.join(tasks)}, not of {task}")


def _task_id(recording: Recording, task: str) -> int | None:
    """The ``task_id`` of ``task`` in a file of several tasks; None if all its rollouts are of it."""
    tasks, numbers = task_names(recording.metadata), task_numbers(recording.metadata)
    if len(tasks) < 2:
        return None
    if numbers is None and recording.version < 3:  # they followed from a catalogue that has changed
        raise ValueError(f"{recording.path} names several tasks and not their task_ids: they cannot be told apart")
    return tasks.index(task) if numbers is None else numbers[tasks.index(task)]


def _of_task(parts: list[Part], task_id: int, path: Path) -> list[Part]:
    """The rollouts of these decoded parts that have that ``task_id``."""
    kept = []
    for part in parts:
        numbers = next((value for key, value in part.values.items() if key[1:] == (TASK_ID,)), None)
        if numbers is None:
            raise ValueError(f"{path} holds several tasks and no {TASK_ID!r}: its rollouts cannot be told apart")
        kept.append(part.select((numbers[:, 0, 0] == task_id).nonzero().flatten().tolist()))
    return [part for part in kept if part.rows]
