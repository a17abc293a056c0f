"""What the stages log, in TorchRL's loggers beside ``metrics.jsonl``: ``--logger csv tensorboard wandb mlflow mcap``.

Each command that logs is an experiment of its own in ``<run_dir>/logs/<number>``: a stage that runs again gets a new
curve instead of a second line in the old one. ``tensorboard --logdir <run_dir>/logs`` shows them beside each other.
MLflow writes to ``<run_dir>/logs/mlflow.db`` unless ``MLFLOW_TRACKING_URI`` names a server; Weights & Biases asks its
server unless ``WANDB_MODE=offline``.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import io
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.record.loggers import CSVLogger, Logger, MLFlowLogger, TensorboardLogger, WandbLogger

from worldenv_trl import keys
from worldenv_trl.data import episodes_from_rollouts
from worldenv_trl.record import MCAPLogger, read_rollouts
from worldenv_trl.report import video_webm

LABELS = ("protocol", "policy", "rollouts", "split", "mode", "task")
"""Texts of a line that tell its figures from those of other lines: they become part of the name."""
FPS = 20


def _nothing(logger: Logger, name: str, what: Any) -> None:
    """For what a logger does not take."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """How a logger is made, and how it takes what is no scalar."""

    package: str | None
    """What must be installed beside torchrl."""
    make: Callable[[Path, str], Logger]
    """From the folder of the experiment (``<run_dir>/logs/<number>``) and the name of the run."""
    settings: Callable[[Logger, dict[str, Any]], None] = lambda logger, settings: logger.log_hparams(settings)
    image: Callable[[Logger, str, Path], None] = _nothing
    video: Callable[[Logger, str, Tensor], None] = lambda logger, name, video: logger.log_video(name, video[None])
    """Of frames uint8 ``[T, 3, H, W]``."""
    page: Callable[[Logger, str, Path], None] = _nothing
    close: Callable[[Logger], None] = lambda logger: logger.shutdown()


def _tensorboard_image(logger: Logger, name: str, path: Path) -> None:
    logger.experiment.add_image(name, np.asarray(Image.open(path).convert("RGB")), 0, dataformats="HWC")


def _tensorboard_video(logger: Logger, name: str, video: Tensor) -> None:
    from tensorboard.compat.proto.summary_pb2 import Summary

    # TensorBoard shows a GIF as an image; log_video would need moviepy older than 2, and drops the video without.
    first, *more = (Image.fromarray(frame) for frame in video.permute(0, 2, 3, 1).contiguous().numpy())
    encoded = io.BytesIO()
    first.save(encoded, "GIF", save_all=True, append_images=more, duration=1000 // FPS, loop=0)
    size = {"height": first.height, "width": first.width, "colorspace": 3}
    image = Summary.Image(encoded_image_string=encoded.getvalue(), **size)
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), 0)


def _tensorboard_settings(logger: Logger, settings: dict[str, Any]) -> None:
    # Not log_hparams: it would make a run of its own beside this one.
    logger.experiment.add_text("settings", "\n".join(f"- {key}: {value}" for key, value in settings.items()), 0)


def _mcap_image(logger: Logger, name: str, path: Path) -> None:
    pixels = torch.from_numpy(np.array(Image.open(path).convert("RGB")))
    logger.log_video(name, pixels.permute(2, 0, 1)[None], fps=FPS)


def _mcap_page(logger: Logger, name: str, path: Path) -> None:
    now = time.time_ns()
    about = {"name": f"{name}.html", "media_type": "text/html"}
    logger.experiment.attach(log_time=now, create_time=now, data=path.read_bytes(), **about)


def _make_wandb(folder: Path, name: str) -> Logger:
    folder.mkdir(parents=True, exist_ok=True)
    options = {"project": os.environ.get("WANDB_PROJECT", "worldenv_trl"), "group": name}
    return WandbLogger(f"{name} {folder.name}", log_dir=str(folder), log_env_packages=False, **options)


def _wandb_image(logger: Logger, name: str, path: Path) -> None:
    import wandb

    logger.experiment.log({name: wandb.Image(str(path))})


def _wandb_video(logger: Logger, name: str, video: Tensor) -> None:
    import wandb

    with tempfile.TemporaryDirectory() as scratch:  # a file of ours: wandb would need moviepy to encode one
        logger.experiment.log({name: wandb.Video(str(_webm(scratch, name, video)), format="webm")})


def _wandb_page(logger: Logger, name: str, path: Path) -> None:
    import wandb

    logger.experiment.log({name: wandb.Html(path.read_text(), inject=False)})


def _make_mlflow(folder: Path, name: str) -> Logger:
    server = os.environ.get("MLFLOW_TRACKING_URI")
    if server:
        return MLFlowLogger(name, server)
    logs = folder.parent.resolve()
    logs.mkdir(parents=True, exist_ok=True)
    return MLFlowLogger(name, f"sqlite:///{logs / 'mlflow.db'}", artifact_location=(logs / "mlflow").as_uri())


def _mlflow_settings(logger: Logger, settings: dict[str, Any]) -> None:
    import mlflow

    mlflow.log_params(settings)  # not log_hparams: in torchrl 0.14.1 it needs omegaconf for a dictionary, too


def _mlflow_file(logger: Logger, name: str, path: Path) -> None:
    import mlflow

    mlflow.log_artifact(str(path), name.rpartition("/")[0])


def _mlflow_video(logger: Logger, name: str, video: Tensor) -> None:
    with tempfile.TemporaryDirectory() as scratch:  # a file of ours: log_video needs torchcodec
        _mlflow_file(logger, name, _webm(scratch, name, video))


def _mlflow_close(logger: Logger) -> None:
    import mlflow

    mlflow.end_run()


def _webm(folder: str, name: str, video: Tensor) -> Path:
    path = Path(folder) / f"{name.rpartition('/')[2]}.webm"
    path.write_bytes(video_webm(video, fps=FPS))
    return path


KINDS = {
    "csv": Kind(None, lambda folder, name: CSVLogger("csv", str(folder))),
    "tensorboard": Kind(
        "tensorboard",
        lambda folder, name: TensorboardLogger("tensorboard", str(folder)),
        settings=_tensorboard_settings,
        image=_tensorboard_image,
        video=_tensorboard_video,
    ),
    "wandb": Kind("wandb", _make_wandb, image=_wandb_image, video=_wandb_video, page=_wandb_page),
    "mlflow": Kind(
        "mlflow",
        _make_mlflow,
        settings=_mlflow_settings,
        image=_mlflow_file,
        video=_mlflow_video,
        page=_mlflow_file,
        close=_mlflow_close,
    ),
    "mcap": Kind(
        None,
        lambda folder, name: MCAPLogger("metrics", folder),
        image=_mcap_image,
        video=lambda logger, name, video: logger.log_video(name, video, fps=FPS),
        page=_mcap_page,
    ),
}


def check_loggers(kinds: Sequence[str]) -> None:
    """Raises ``ValueError`` for a logger that does not exist, is named twice or whose package is missing."""
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(f"logger must be of {', '.join(KINDS)}, got {kind!r}")
        package = KINDS[kind].package
        if package is not None and importlib.util.find_spec(package) is None:
            raise ValueError(f"the logger {kind} needs a package that is not installed: pip install {package}")
    if len(set(kinds)) < len(kinds):
        raise ValueError(f"logger names one twice: {', '.join(kinds)}")


class Loggers:
    """Some loggers as one. One that fails is left out from then on, with a warning: the run goes on.

    Args:
        loggers: by their kind.
    """

    def __init__(self, loggers: dict[str, Logger] | None = None) -> None:
        self.loggers = dict(loggers or {})
        self._lines: Counter[tuple[str, ...]] = Counter()

    @classmethod
    def open(cls, kinds: Sequence[str], run_dir: Path, settings: dict[str, Any]) -> Loggers:
        """A new experiment of each kind, in ``<run_dir>/logs``.

        Args:
            kinds: of :data:`KINDS`.
            run_dir: the run's folder.
            settings: of the run, by name; noted in every experiment.

        Raises:
            ValueError: see :func:`check_loggers`, or naming a logger that cannot start.
        """
        check_loggers(kinds)
        loggers: dict[str, Logger] = {}
        if not kinds:
            return cls()
        numbers = [int(path.name) for path in (run_dir / "logs").glob("[0-9]*") if path.name.isdigit()]
        folder = run_dir / "logs" / f"{max(numbers, default=0) + 1:03d}"
        folder.mkdir(parents=True)
        for kind in kinds:
            try:
                loggers[kind] = KINDS[kind].make(folder, run_dir.resolve().name)
                KINDS[kind].settings(loggers[kind], settings)
            except Exception as error:  # of a server, a login, a database: whatever that package raises
                cls(loggers).close()
                offline = "; WANDB_MODE=offline logs without a server" if kind == "wandb" else ""
                raise ValueError(f"the logger {kind} cannot start ({_said(error)}): leave it out{offline}") from error
        return cls(loggers)

    def log(self, stage: str, values: dict[str, Any]) -> None:
        """The numbers of one line of ``metrics.jsonl`` as ``<stage>/<labels>/<name>``.

        A line without ``step`` is counted: the first of its kind in this command is step 0.
        """
        labels = [_in_a_name(values[label]) for label in LABELS if isinstance(values.get(label), str)]
        numbers = {
            "/".join([_in_a_name(stage), *labels, _in_a_name(name)]): float(value)
            for name, value in values.items()
            if isinstance(value, int | float) and not isinstance(value, bool) and name != "step"
        }
        if not numbers or not self.loggers:
            return
        step = values.get("step")
        if step is None:
            step, self._lines[tuple(numbers)] = self._lines[tuple(numbers)], self._lines[tuple(numbers)] + 1
        self._each(lambda kind: _log, numbers, step)

    def images(self, paths: Iterable[Path]) -> None:
        """Pictures, each under the name of its folder and file."""
        for path in sorted(paths):
            self._each(lambda kind: kind.image, f"{path.parent.name}/{path.stem}", path)

    def recordings(self, paths: Iterable[Path]) -> None:
        """The first rollout of each recording as a video of every camera."""
        for path in sorted(paths) if self.loggers else ():
            try:
                films = _films(read_rollouts(path, rollouts=slice(0, 1)))
            except (ValueError, OSError) as error:  # damaged since: no matter for the run
                warnings.warn(f"{path.name} is not logged as a video: {error}", stacklevel=2)
                continue
            for camera, video in films.items():
                self._each(lambda kind: kind.video, f"videos/{path.stem}_{camera}", video)

    def page(self, path: Path) -> None:
        """An HTML file, if it is there."""
        if not path.is_file():
            return
        self._each(lambda kind: kind.page, f"report/{path.stem}", path)

    def close(self) -> None:
        """Completes what the loggers write."""
        self._each(lambda kind: kind.close)
        self.loggers.clear()

    def _each(self, take: Callable[[Kind], Callable[..., None]], *what: Any) -> None:
        for name, logger in list(self.loggers.items()):
            try:
                take(KINDS[name])(logger, *what)
            except Exception as error:  # its server is gone, the disk is full, ...
                del self.loggers[name]
                print(f"warning: the logger {name} failed and is left out: {_said(error)}", file=sys.stderr)


def _films(rollouts: TensorDictBase) -> dict[str, Tensor]:
    """Frames uint8 ``[T, 3, H, W]`` of every camera of one rollout ``[1, D]``: all, or those at decisions if no more
    were recorded.
    """
    try:
        episode = episodes_from_rollouts(rollouts)
    except ValueError:
        rows = rollouts[keys.MASK] if keys.MASK in rollouts.keys(True) else torch.ones(rollouts.shape, dtype=torch.bool)
        seen = {name: value for name, value in rollouts["observation"].items() if value.dtype == torch.uint8}
        return {keys.camera_of(name): images[rows] for name, images in seen.items()}
    frame = torch.arange(int(episode["length"][0]) + 1)
    return {camera: episode.frames(camera, torch.zeros_like(frame), frame) for camera in episode.cameras}


def _log(logger: Logger, numbers: dict[str, float], step: int) -> None:
    logger.log_metrics(numbers, step=step)


def _in_a_name(text: str) -> str:
    """Letters that every logger takes in a name and every disk in a file's."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-.") else "_" for c in text).strip("_.") or "_"


def _said(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
