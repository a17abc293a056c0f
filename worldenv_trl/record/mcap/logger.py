"""Training curves and videos to MCAP, as a TorchRL logger."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
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

from worldenv_trl.record.mcap.protobuf import FixedMessage, MessageField

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
        FileExistsError: if the file exists and ``overwrite`` is False, or another logger is writing it.
        ValueError: from any method after :meth:`shutdown`, and for a name that already is of another kind.
        OSError: from :meth:`shutdown`, if the file could not be completed.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     logger = MCAPLogger("post_train", folder)
        ...     logger.log_scalar("reward", 0.5, step=1)
        ...     logger.shutdown()
        ...     logger.path.name
        'post_train.mcap'
    """

    def __init__(self, exp_name: str, log_dir: str | os.PathLike, *, overwrite: bool = False) -> None:
        self.path = Path(log_dir) / f"{exp_name}.mcap"
        if self.path.exists() and not overwrite:
            raise FileExistsError(f"{self.path} exists: pass overwrite=True or choose another exp_name")
        _require_idle(self.path)
        self._channels: dict[str, tuple[str, Any]] = {}  # kind and channel, by topic
        self._closed = False
        self._timer: threading.Timer | None = None
        super().__init__(exp_name=exp_name, log_dir=str(log_dir))

    def _create_experiment(self) -> foxglove.MCAPWriter:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._context = Context()
        options = MCAPWriteOptions(compression_threads=0)
        writer = foxglove.open_mcap(self.path, allow_overwrite=True, context=self._context, writer_options=options)
        self._lock = open(self.path, "rb")  # noqa: SIM115 - as long as the logger writes
        fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return writer

    def _channel(self, name: str, kind: str, make: Callable[[str], Any]) -> Any:
        """The channel of a name, made at the first call."""
        if self._closed:
            raise ValueError(f"the logger of {self.path} is closed: {name!r} was not logged")
        if not isinstance(name, str):
            raise TypeError(f"the name of what is logged must be text, got {name!r}")
        topic = "/" + name.strip("/")
        known, channel = self._channels.get(topic, (kind, None))
        if known != kind:
            raise ValueError(f"{name!r} was logged as a {known}, it cannot be a {kind}, too: choose another name")
        if channel is None:
            channel = make(topic)
            self._channels[topic] = kind, channel
        return channel

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        numbers = np.array([[float(value)]]).view(np.uint8), np.array([[_NO_STEP if step is None else step]])
        message = _SCALAR.pack([numbers[0], numbers[1].astype(np.int64).view(np.uint8)])[0]
        schema = Schema(name=_SCALAR.name, encoding="protobuf", data=_SCALAR.schema())
        channel = self._channel(
            name, "scalar", lambda t: Channel(t, schema=schema, message_encoding="protobuf", context=self._context)
        )
        channel.log(message, log_time=time.time_ns())
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
        self._closed = True
        try:
            super().shutdown(timeout)
        except RuntimeError as error:
            raise OSError(f"{self.path} could not be completed ({error}): is the disk full?") from error
        finally:
            self._lock.close()

    def log_video(self, name: str, video: Tensor, step: int | None = None, *, fps: float = 20.0, **_: Any) -> None:
        """Frames uint8 [T, 3, H, W], or several videos [N, T, 3, H, W], one after another; 20 a second by default.

        Raises:
            ValueError: for another shape or dtype.
        """
        if video.dtype != torch.uint8 or video.ndim not in (4, 5) or video.shape[-3] != 3:
            raise ValueError(f"video must be uint8 [(N,) T, 3, H, W], got {video.dtype} {tuple(video.shape)}")
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}")
        channel = self._channel(name, "video", lambda t: RawImageChannel(t, context=self._context))
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
            channel.log(message, log_time=at)
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

    def log_histogram(
        self, name: str, data: Sequence | Tensor, *, step: int | None = None, bins: int = 32, **_: Any
    ) -> None:
        """A histogram as JSON on ``/<name>``: ``counts`` [bins], ``edges`` [bins + 1], ``step``."""
        values = np.asarray(data.detach().cpu() if isinstance(data, Tensor) else data, dtype=np.float64).ravel()
        counts, edges = np.histogram(values, bins=bins)
        channel = self._channel(
            name, "histogram", lambda t: Channel(t, message_encoding="json", schema=_HISTOGRAM, context=self._context)
        )
        message = {"counts": counts.tolist(), "edges": edges.tolist(), "step": _NO_STEP if step is None else step}
        channel.log(json.dumps(message).encode(), log_time=time.time_ns())
        self._flush_soon()

    def log_str(self, name: str, value: str, step: int | None = None) -> None:
        """A line of text on the ``/log`` topic."""
        channel = self._channel("log", "text", lambda topic: LogChannel(topic, context=self._context))
        now = time.time_ns()
        text = value if step is None else f"step {step}: {value}"
        stamp = Timestamp(*divmod(now, 1_000_000_000))
        channel.log(Log(timestamp=stamp, level=LogLevel.Info, message=text, name=name), log_time=now)
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


def _require_idle(path: Path) -> None:
    """Raises ``FileExistsError`` if another logger is writing the file."""
    if not path.exists():
        return
    with open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise FileExistsError(f"{path} is being written by another logger: choose another exp_name") from error
