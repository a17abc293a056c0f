"""Rollouts to MCAP."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import foxglove
import numpy as np
import torch
from foxglove import Channel, Context, Schema
from foxglove.channels import LogChannel, PoseInFrameChannel, RawImageChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import Log, LogLevel, Pose, PoseInFrame, Quaternion, RawImage, Timestamp, Vector3
from tensordict import TensorDictBase
from torch import Tensor

from worldenv_trl.keys import CONTROL_HZ, FRAMES, INSTRUCTION, STATE, STEP_MASK, SUCCESS
from worldenv_trl.record.layout import Layout, executed_entries, leaves, to_bytes

__all__ = ["FORMAT", "PARTIAL_SUFFIX", "VERSION", "RolloutWriter"]

FORMAT, VERSION = "worldenv_trl.rollouts", 1
PARTIAL_SUFFIX = ".partial.mcap"
_PERIOD_NS = 1_000_000_000 // CONTROL_HZ
_CHUNK_BYTES = 4 * 2**20  # most of a frame repeats its predecessor: larger chunks halve the file
_FIRST_GUESS = 0.5  # compressed size over raw size, before anything was measured


class RolloutWriter:
    """Writes TorchRL rollouts to one MCAP file that Foxglove and Rerun open and :func:`read_rollouts` reads back.

    Rollouts follow each other in time at 20 steps a second: images as ``foxglove.RawImage`` on ``/observation/image``,
    one ``worldenv_trl.Step`` message per entry on ``/step`` (a field per key, so they can be plotted), the first values
    on ``/reset``, the hand as ``PoseInFrame`` on ``/hand``, the instruction as ``Log`` on ``/instruction``. Everything
    needed to rebuild the TensorDict is metadata written before the messages.

    The file appears under its name when the writer is closed. Until then, and after an exception, what was written is
    in ``<name>.partial.mcap``, which :func:`read_rollouts` opens when named.

    Args:
        path: ends in ``.mcap``; folders are created.

    Keyword Args:
        metadata: plain values (strings, numbers, lists, dicts), for instance ``{"tasks": [...], "seed": 0}``. ``task``
            or ``tasks`` names the tasks for ``read_rollouts(path, task=...)``.
        attachments: name -> bytes, text or the path of a file.
        overwrite: replace an existing file.

    Raises:
        FileExistsError: if the file exists and ``overwrite`` is False.
        ValueError: for another suffix, or metadata that is not plain.

    Examples:
        >>> with RolloutWriter("runs/demo.mcap", metadata={"task": "starter/open_the_top_drawer"}) as writer:
        ...     writer.write(env.rollout(64))
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        metadata: Mapping[str, Any] | None = None,
        attachments: Mapping[str, bytes | str | os.PathLike] | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        if self.path.suffix != ".mcap" or self.path.name.endswith(PARTIAL_SUFFIX):
            raise ValueError(f"path must end in .mcap (not {PARTIAL_SUFFIX}), got {self.path}")
        if self.path.exists() and not overwrite:
            raise FileExistsError(f"{self.path} exists: pass overwrite=True to replace it")
        try:
            described = {str(key): json.dumps(value) for key, value in (metadata or {}).items()}
        except TypeError as error:
            raise ValueError(f"metadata must hold plain values (text, numbers, lists, dicts): {error}") from error
        files = {name: _contents(name, value) for name, value in (attachments or {}).items()}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._partial = self.path.with_name(self.path.stem + PARTIAL_SUFFIX)
        _require_space(self.path, sum(map(len, files.values())) + 65536)
        self._context = Context()
        options = MCAPWriteOptions(chunk_size=_CHUNK_BYTES, compression_threads=0, profile="")
        self._file = foxglove.open_mcap(
            self._partial, allow_overwrite=True, context=self._context, writer_options=options
        )
        self._file.write_metadata(FORMAT, {"version": str(VERSION)})
        if described:
            self._file.write_metadata("metadata", described)
        for name, data in files.items():
            self._file.attach(log_time=0, create_time=0, name=name, media_type="application/octet-stream", data=data)
        self._layouts: list[Layout] = []
        self._channels: dict[str, Any] = {}
        self._closed = False
        self._raw_bytes = 0
        self._rollouts = 0
        self._time = 0

    def write(self, rollouts: TensorDictBase) -> None:
        """Appends rollouts ``[*B, T]`` with their root and next entries; one action or one decision per entry.

        Only what ``("collector", "mask")`` marks is stored (without a mask: up to the first ``done``). Text must be
        constant within a rollout. Writes may differ in B and T.

        Raises:
            ValueError: for a writer that is closed, or entries that are neither tensors nor text.
            OSError: before anything of ``rollouts`` is written, if the disk seems too small for it.
        """
        if self._closed:
            raise ValueError(f"the writer of {self.path} is closed")
        if rollouts.ndim < 1 or 0 in rollouts.shape:
            raise ValueError(f"rollouts must be [*B, T] with at least one entry, got {list(rollouts.shape)}")
        tensors, texts = leaves(rollouts)
        valid = executed_entries(rollouts)
        flat = {key: value.reshape(*valid.shape, *value.shape[rollouts.ndim :]) for key, value in tensors.items()}
        layout = Layout.of(flat, texts, valid)
        lengths = valid.sum(-1)
        texts = {path: _row_texts(path, value, valid.shape, lengths) for path, value in texts.items()}
        raw = sum(int(lengths.sum()) * e.nbytes for e in (*layout.images, *layout.numbers))
        _require_space(self.path, int(raw * self._compression()) + 65536)

        if layout not in self._layouts:
            self._layouts.append(layout)
            self._file.write_metadata(f"{FORMAT}.layout", {"json": json.dumps(layout.to_json())})
        index = self._layouts.index(layout)
        record = {
            "layout": index,
            "batch": list(rollouts.shape[:-1]),
            "steps": rollouts.shape[-1],
            "lengths": lengths.tolist(),
            "texts": [[list(path), texts[path]] for path in layout.texts],
        }
        if layout.splits_frames:
            executed = flat["next", STEP_MASK].sum(-1)
            record["executed"] = [executed[row, :length].tolist() for row, length in enumerate(lengths.tolist())]
        self._file.write_metadata(f"{FORMAT}.write", {"json": json.dumps(record)})
        prefix = f"/layout_{index + 1}" if index else ""
        for row, length in enumerate(lengths.tolist()):
            self._write_row(layout, prefix, {key: value[row, : max(length, 1)] for key, value in flat.items()}, length)
            said = texts.get((INSTRUCTION,)) or texts.get(("next", INSTRUCTION))
            if said:
                self._say(said[row], flat, row, length)
            self._rollouts += 1
        self._raw_bytes += raw

    def _write_row(self, layout: Layout, prefix: str, row: dict[tuple[str, ...], Tensor], length: int) -> None:
        """One rollout: its values [L, ...] by path."""
        start, per_entry = self._time, layout.steps_per_entry
        number = np.full((max(length, 1), 1), self._rollouts, np.int64).view(np.uint8)
        chained = [to_bytes(row[e.key][:1]) for e in layout.numbers if e.chained]
        message = layout.reset_message().pack([number[:1], *chained])[0]
        self._message_channel(f"{prefix}/reset", layout.reset_message).log(message, log_time=start)
        for entry in layout.images:
            if entry.stored in ("chained", "last_of_frames"):
                self._log_images(prefix + entry.topic, row[entry.key][0], start)

        values = [row[e.key if e.stored == "root" else ("next", *e.key)][:length] for e in layout.numbers]
        steps = np.arange(length, dtype=np.int64)[:, None].view(np.uint8)
        messages = layout.step_message().pack([number[:length], steps, *map(to_bytes, values)]) if length else []
        channel = self._message_channel(f"{prefix}/step", layout.step_message)
        poses = _hand_poses(row.get(("next", *STATE)), length)
        for step in range(length):
            time = start + step * per_entry * _PERIOD_NS
            for entry in layout.images:
                if entry.stored == "last_of_frames":
                    continue
                image = row[entry.key if entry.stored == "root" else ("next", *entry.key)][step]
                if entry.key == (FRAMES,) and layout.splits_frames:
                    executed = int(row["next", STEP_MASK][step].sum())
                    self._log_images(prefix + entry.topic, image[:executed], time + _PERIOD_NS)
                    unseen = time + (executed + 1) * _PERIOD_NS
                    self._log_images(f"{prefix}{entry.topic}/after_stop", image[executed:], unseen)
                else:
                    self._log_images(prefix + entry.topic, image, time + (0 if entry.stored == "root" else _PERIOD_NS))
            time += per_entry * _PERIOD_NS
            if poses is not None:
                self._typed_channel("/hand", PoseInFrameChannel).log(
                    PoseInFrame(timestamp=_timestamp(time), frame_id="world", pose=poses[step]), log_time=time
                )
            channel.log(messages[step], log_time=time)  # last: a step whose message is there is complete
        self._time = start + (length * per_entry + 1) * _PERIOD_NS

    def _log_images(self, topic: str, images: Tensor, time: int) -> None:
        """[(C,) 3, H, W] from ``time`` on, one period apart."""
        images = images.unsqueeze(0) if images.ndim == 3 else images
        if not len(images):
            return
        channel = self._typed_channel(topic, RawImageChannel)
        pixels = np.ascontiguousarray(images.permute(0, 2, 3, 1).numpy())  # [C, H, W, 3]
        height, width = pixels.shape[1:3]
        for image in pixels:
            message = RawImage(
                timestamp=_timestamp(time),
                frame_id="camera",
                width=width,
                height=height,
                encoding="rgb8",
                step=3 * width,
                data=image.tobytes(),
            )
            channel.log(message, log_time=time)
            time += _PERIOD_NS

    def _say(self, text: str, flat: dict[tuple[str, ...], Tensor], row: int, length: int) -> None:
        """The instruction, and how it ended, at the end of the rollout just written."""
        success = flat.get(("next", SUCCESS))
        outcome = ""
        if success is not None and length:
            outcome = ": reached" if bool(success[row, :length].any()) else ": not reached"
        message = Log(
            timestamp=_timestamp(self._time - _PERIOD_NS),
            level=LogLevel.Info,
            message=f"rollout {self._rollouts}: {text}{outcome}",
            name="instruction",
        )
        self._typed_channel("/instruction", LogChannel).log(message, log_time=self._time - _PERIOD_NS)

    def _typed_channel(self, topic: str, kind: type) -> Any:
        if topic not in self._channels:
            self._channels[topic] = kind(topic, context=self._context)
        return self._channels[topic]

    def _message_channel(self, topic: str, message) -> Channel:
        if topic not in self._channels:
            kind = message()
            schema = Schema(name=kind.name, encoding="protobuf", data=kind.schema())
            self._channels[topic] = Channel(topic, schema=schema, message_encoding="protobuf", context=self._context)
        return self._channels[topic]

    def _compression(self) -> float:
        """Expected size over raw size, with a margin."""
        if self._raw_bytes < 4 * _CHUNK_BYTES:
            return _FIRST_GUESS
        return 1.5 * (self._partial.stat().st_size + _CHUNK_BYTES // 8) / self._raw_bytes

    def close(self) -> None:
        """Finishes the file and gives it its name.

        Raises:
            OSError: if the file could not be completed; what was written stays in the partial file.
        """
        if self._closed:
            return
        self._close_file()
        os.replace(self._partial, self.path)

    def _close_file(self) -> None:
        self._closed = True
        self._file.close()
        with open(self._partial, "rb+") as file:
            file.seek(-8, os.SEEK_END)
            if file.read() != b"\x89MCAP0\r\n":
                raise OSError(f"{self._partial} could not be completed: is the disk full?")
            os.fsync(file.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exception_type: type | None, *_: object) -> None:
        if exception_type is None:
            self.close()
        elif not self._closed:
            self._close_file()


def _contents(name: str, value: bytes | str | os.PathLike) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, os.PathLike):
        path = Path(value)
        if not path.is_file():
            raise FileNotFoundError(f"attachment {name!r}: there is no file {path}")
        return path.read_bytes()
    return str(value).encode()


def _require_space(path: Path, needed: int) -> None:
    free = shutil.disk_usage(path.parent).free
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"{path} needs about {needed / 2**20:.0f} MiB more and the disk has {free / 2**20:.0f} MiB free: "
            "make room or write elsewhere",
        )


def _row_texts(path: tuple[str, ...], value: Any, shape: tuple[int, int], lengths: Tensor) -> list[str]:
    """One text for each rollout, from nested lists [*B, T]."""
    rows, steps = shape
    words = [value] * (rows * steps) if isinstance(value, str) else _flatten(value)
    if len(words) != rows * steps or any(not isinstance(word, str) for word in words):
        raise ValueError(f"entry {path} must hold one text for each entry of the rollouts")
    out = []
    for row, length in enumerate(lengths.tolist()):
        said = words[row * steps : row * steps + max(length, 1)]
        if any(word != said[0] for word in said):
            raise ValueError(f"entry {path} changes within rollout {row}: text must be constant within a rollout")
        out.append(said[0])
    return out


def _flatten(value: Any) -> list:
    return [word for part in value for word in _flatten(part)] if isinstance(value, list) else [value]


def _hand_poses(states: Tensor | None, length: int) -> list[Pose] | None:
    """Poses for the viewer, from position, axis-angle and opening [L, 7]."""
    if states is None or states.shape[-1] != 7 or not length:
        return None
    states = states[:length].double()
    angle = states[:, 3:6].norm(dim=-1, keepdim=True)
    axis = states[:, 3:6] / angle.clamp(min=1e-12)
    quaternion = torch.cat([axis * (angle / 2).sin(), (angle / 2).cos()], -1)
    return [
        Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=a, y=b, z=c, w=w))
        for (x, y, z), (a, b, c, w) in zip(states[:, :3].tolist(), quaternion.tolist(), strict=True)
    ]


def _timestamp(time_ns: int) -> Timestamp:
    return Timestamp(*divmod(time_ns, 1_000_000_000))
