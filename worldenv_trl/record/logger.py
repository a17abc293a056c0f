"""Training curves and videos to MCAP, as a TorchRL logger."""

from __future__ import annotations

import dataclasses
import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import torch
from foxglove import Channel, Context, Schema
from foxglove.channels import LogChannel, RawImageChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import Log, LogLevel, RawImage, Timestamp
from torch import Tensor
from torchrl.record.loggers.common import Logger

from worldenv_trl.record.protobuf import FixedMessage, MessageField

__all__ = ["MCAPLogger"]

_SCALAR = FixedMessage(
    "worldenv_trl.Scalar", [MessageField("value", torch.float64, 1), MessageField("step", torch.int64, 1)]
)
_NO_STEP = -1
_FLUSH_SECONDS = 0.5


class MCAPLogger(Logger):
    """Writes ``<log_dir>/<exp_name>.mcap``: one plottable topic for each scalar, videos as raw images.

    Scalars are ``worldenv_trl.Scalar`` messages (``value``, ``step``; -1 without a step) on ``/<name>``, stamped with
    the time of logging. What was logged is on disk after :meth:`flush`, or half a second later, also when the process
    is killed then.

    Args:
        exp_name: file name without suffix.
        log_dir: folder, created if missing.

    Keyword Args:
        overwrite: replace an existing file.

    Raises:
        FileExistsError: if the file exists and ``overwrite`` is False.

    Examples:
        >>> logger = MCAPLogger("post_train", "runs/demo")
        >>> logger.log_scalar("reward", 0.5, step=1)
        >>> logger.shutdown()
    """

    def __init__(self, exp_name: str, log_dir: str | os.PathLike, *, overwrite: bool = False) -> None:
        self.path = Path(log_dir) / f"{exp_name}.mcap"
        if self.path.exists() and not overwrite:
            raise FileExistsError(f"{self.path} exists: pass overwrite=True or choose another exp_name")
        self._channels: dict[str, Any] = {}
        self._timer: threading.Timer | None = None
        super().__init__(exp_name=exp_name, log_dir=str(log_dir))

    def _create_experiment(self) -> foxglove.MCAPWriter:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._context = Context()
        options = MCAPWriteOptions(compression_threads=0)
        return foxglove.open_mcap(self.path, allow_overwrite=True, context=self._context, writer_options=options)

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        numbers = np.array([[float(value)]]).view(np.uint8), np.array([[_NO_STEP if step is None else step]])
        message = _SCALAR.pack([numbers[0], numbers[1].astype(np.int64).view(np.uint8)])[0]
        topic = _topic(name)
        if topic not in self._channels:
            schema = Schema(name=_SCALAR.name, encoding="protobuf", data=_SCALAR.schema())
            self._channels[topic] = Channel(topic, schema=schema, message_encoding="protobuf", context=self._context)
        self._channels[topic].log(message, log_time=time.time_ns())
        self._flush_soon()

    def _flush_soon(self) -> None:
        """Flushes half a second from now, so that a kill loses less than a second and a burst costs one flush."""
        if self._timer is None or not self._timer.is_alive():
            self._timer = threading.Timer(_FLUSH_SECONDS, self.flush)
            self._timer.daemon = True
            self._timer.start()

    def shutdown(self, timeout: float | None = None) -> None:
        """Completes the file."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()
        super().shutdown(timeout)

    def log_video(self, name: str, video: Tensor, step: int | None = None, *, fps: float = 20.0, **_: Any) -> None:
        """Frames uint8 [T, 3, H, W], or several videos [N, T, 3, H, W], one after another; 20 a second by default.

        Raises:
            ValueError: for another shape or dtype.
        """
        if video.dtype != torch.uint8 or video.ndim not in (4, 5) or video.shape[-3] != 3:
            raise ValueError(f"video must be uint8 [(N,) T, 3, H, W], got {video.dtype} {tuple(video.shape)}")
        topic = _topic(name)
        if topic not in self._channels:
            self._channels[topic] = RawImageChannel(topic, context=self._context)
        frames = video.reshape(-1, *video.shape[-3:]).permute(0, 2, 3, 1).contiguous().cpu().numpy()
        now = time.time_ns()
        for place, frame in enumerate(frames):
            at = now + int(place * 1e9 / fps)
            message = RawImage(
                timestamp=Timestamp(*divmod(at, 1_000_000_000)),
                frame_id="" if step is None else f"step {step}",
                width=frame.shape[1],
                height=frame.shape[0],
                encoding="rgb8",
                step=3 * frame.shape[1],
                data=frame.tobytes(),
            )
            self._channels[topic].log(message, log_time=at)
        self._flush_soon()

    def log_hparams(self, cfg: Any) -> None:
        """A dictionary or dataclass of settings, as metadata of the file."""
        if dataclasses.is_dataclass(cfg) and not isinstance(cfg, type):
            cfg = dataclasses.asdict(cfg)
        if not isinstance(cfg, Mapping):
            raise ValueError(f"hparams must be a dictionary or a dataclass, got {type(cfg).__name__}")
        values = {str(key): json.dumps(value, default=str) for key, value in cfg.items()}
        if values:
            self.experiment.write_metadata("hparams", values)

    def log_histogram(self, name: str, data: Sequence, *, step: int | None = None, bins: int = 32, **_: Any) -> None:
        """A histogram as JSON on ``/<name>``: ``counts`` [bins], ``edges`` [bins + 1], ``step``."""
        values = np.asarray(data.detach().cpu() if isinstance(data, Tensor) else data, dtype=np.float64).ravel()
        counts, edges = np.histogram(values, bins=bins)
        topic = _topic(name)
        if topic not in self._channels:
            self._channels[topic] = Channel(topic, message_encoding="json", schema=_HISTOGRAM, context=self._context)
        message = {"counts": counts.tolist(), "edges": edges.tolist(), "step": _NO_STEP if step is None else step}
        self._channels[topic].log(json.dumps(message).encode(), log_time=time.time_ns())
        self._flush_soon()

    def log_str(self, name: str, value: str, step: int | None = None) -> None:
        """A line of text on the ``/log`` topic."""
        if "/log" not in self._channels:
            self._channels["/log"] = LogChannel("/log", context=self._context)
        now = time.time_ns()
        text = value if step is None else f"step {step}: {value}"
        stamp = Timestamp(*divmod(now, 1_000_000_000))
        self._channels["/log"].log(Log(timestamp=stamp, level=LogLevel.Info, message=text, name=name), log_time=now)
        self._flush_soon()

    def __repr__(self) -> str:
        return f"MCAPLogger(exp_name={self.exp_name!r}, path={str(self.path)!r})"


_HISTOGRAM = {
    "type": "object",
    "title": "worldenv_trl.Histogram",
    "properties": {
        "counts": {"type": "array", "items": {"type": "number"}},
        "edges": {"type": "array", "items": {"type": "number"}},
        "step": {"type": "integer"},
    },
}


def _topic(name: str) -> str:
    return "/" + name.strip("/")
