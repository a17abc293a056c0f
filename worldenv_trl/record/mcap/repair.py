"""Damaged or unfinished recordings as whole files again."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

from worldenv_trl.record.mcap.file import PARTIAL_SUFFIX, REPAIRED_SUFFIX, McapFile
from worldenv_trl.record.mcap.recording import Recording
from worldenv_trl.record.mcap.writer import FORMAT

__all__ = ["Repair", "repair"]


@dataclass(frozen=True)
class Repair:
    """What a repair kept: ``messages`` of the file, and what it ``lost``, one line each."""

    target: Path
    messages: int
    lost: tuple[str, ...]


def repair(path: str | os.PathLike, target: str | os.PathLike | None = None, *, overwrite: bool = False) -> Repair:
    """Rewrites a recording with every metadata record, attachment and complete message that is left in it.

    The result is written beside its name and renamed when it is complete; the damaged file stays.

    Args:
        path: a recording, also an unfinished ``*.partial.mcap``.
        target: where to; by default ``<name>.repaired.mcap`` beside it.

    Keyword Args:
        overwrite: replace an existing target.

    Raises:
        FileNotFoundError: if there is no such file.
        FileExistsError: if the target exists and ``overwrite`` is False.
        ValueError: if the file is no recording, or is whole, or holds no complete step.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    recording = Recording(path)
    scan = recording.scan
    name = path.name.removesuffix(".mcap").removesuffix(".partial")
    target = path.with_name(f"{name}{REPAIRED_SUFFIX}") if target is None else Path(target)
    if target.resolve() == path.resolve():
        raise ValueError(f"the repaired file must have another name than {path}: the damaged one is kept")
    if target.with_name(target.stem + PARTIAL_SUFFIX).resolve() == path.resolve():
        raise ValueError(f"while {target} is written it has the name of the damaged file, {path}: choose another name")
    opened = [list(scan.messages(chunk)) for chunk in scan.chunks]
    count = sum(map(len, opened))
    if scan.intact:
        raise ValueError(f"{path} is whole: there is nothing to repair")
    if not sum(part.done for part in recording.parts(wanted=lambda _: False)):
        lost = f": it {scan.losses[0]}" if scan.losses else ""
        raise ValueError(f"{path} holds no complete step{lost}; there is nothing to save")
    file = McapFile(target, overwrite=overwrite)
    try:
        for record in scan.metadata:
            file.write_metadata(record.name, record.metadata)
            if record.name == FORMAT:
                file.write_metadata(f"{FORMAT}.repaired", {"json": json.dumps(scan.losses)})
        for attachment in scan.attachments:
            file.attach(attachment.name, attachment.data, attachment.media_type)
        channels: dict[int, int] = {}
        for messages in opened:
            for number, _, _, _ in messages:
                if number not in channels:
                    channel = scan.channels[number]
                    schema = scan.schemas[channel.schema_id]
                    channels[number] = file.channel(channel.topic, schema.name, schema.data)
            for number, sequence, time, data in messages:
                file.add(channels[number], time, data, sequence)
            file.end_chunk()
    except BaseException:
        file.abort()
        file.partial.unlink(missing_ok=True)
        raise
    file.close()
    return Repair(target, count, tuple(dict.fromkeys(scan.losses)))
