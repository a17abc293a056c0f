"""Recordings in Rerun.

Rerun opens the MCAP files directly: images, poses and text appear, but it does not plot numbers of messages that it
does not know. Here they become ``Scalars``, with a blueprint that arranges them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from worldenv_trl.record.view.shown import Curve, Shown, shown_rollouts

__all__ = ["APPLICATION", "require_rerun", "rerun_blueprint", "rerun_recording"]

APPLICATION = "worldenv_trl"
# Plots from top to bottom: title, and the entries that belong to it.
PLOTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("outcome", ("reward", "success", "success_prob", "recorded/success", "recorded/success_prob")),
    ("difference from the recording (PSNR, dB)", ("recorded/psnr",)),
    ("action", ("action", "vla_action/chunk")),
    ("policy", ("vla_action/log_probs", "advantage", "ratio", "clipped")),
    ("scale", ("vla_action/scale",)),
    ("hand", ("observation/state/position", "states/position", "predicted_state/position")),
    ("recorded hand", ("recorded/state/position",)),
)
_COLORS = np.array(  # told apart on dark and on light ground
    [[230, 80, 60], [70, 170, 80], [70, 130, 220], [240, 170, 50], [160, 90, 200], [60, 190, 200], [220, 120, 170]]
)
_TITLES = {"image": "camera", "wrist_image": "wrist", "action_map": "action map"}  # else the camera's own name


def rerun_recording(path: str | os.PathLike, rollouts: Sequence[int] | slice = slice(None)) -> Any:
    """A ``rerun.RecordingStream`` of rollouts of a recording, with its blueprint; ``save``, ``spawn`` or serve it.

    Time lines: ``time`` (s, as in the file) and ``step``. Entities: ``/camera/<name>`` images, ``/world/hand`` and
    ``/world/path``, ``/scalars/<entry>`` with a line for each dimension, ``/text``.

    Raises:
        ImportError: if Rerun is not installed.
        FileNotFoundError, ValueError: as :func:`~worldenv_trl.record.read_rollouts`.
    """
    rr = require_rerun()
    shown = list(shown_rollouts(path, rollouts))
    if not shown:
        raise ValueError(f"{path} holds no rollouts to show")
    stream = rr.RecordingStream(APPLICATION)
    for name in ("log_time", "log_tick"):  # when it was converted tells nothing
        stream.disable_timeline(name)
    stream.send_recording_name(Path(path).stem)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("world/hand", rr.TransformAxes3D(0.05), static=True)
    named: set[str] = set()
    for rollout in shown:
        _send(rr, stream, rollout, named, gap=len(shown) > 1)
    stream.send_blueprint(rerun_blueprint(shown))
    return stream


def rerun_blueprint(shown: Sequence[Shown]) -> Any:
    """The blueprint for these rollouts: images and the hand on the left, plots and text on the right."""
    require_rerun()
    import rerun.blueprint as rrb

    images = list(dict.fromkeys(name for rollout in shown for name in rollout.images))
    curves = {curve.name for rollout in shown for curve in rollout.curves}
    cameras = [rrb.Spatial2DView(origin=f"/camera/{name}", name=_title(name)) for name in images]
    plots = []
    for title, wanted in PLOTS:
        names = [name for name in wanted if name in curves]
        if "states/position" in names:  # every step of a decision, not the last one alone
            names.remove("observation/state/position")
        contents = [f"/scalars/{name}" for name in names]
        if contents:
            plots.append(rrb.TimeSeriesView(origin="/scalars", contents=contents, name=title))
    left = [rrb.Grid(*cameras, grid_columns=2)] if cameras else []
    left.append(rrb.Spatial3DView(origin="/world", name="hand"))
    right = [*plots, rrb.TextLogView(origin="/text", name="text")]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[(len(cameras) + 1) // 2, 1] if cameras else [1]),
            rrb.Vertical(*right, row_shares=[*[1.0] * len(plots), max(1.0, 0.2 * len(plots))]),
            column_shares=[2, 3],
        ),
        rrb.TimePanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _title(image: str) -> str:
    name = image.removeprefix("recorded/")
    return ("recorded " if name != image else "") + _TITLES.get(name, name)


def _send(rr: Any, stream: Any, rollout: Shown, named: set[str], gap: bool) -> None:
    def when(steps: Tensor) -> list:
        return [
            rr.TimeColumn("time", duration=rollout.seconds(steps).numpy()),
            rr.TimeColumn("step", sequence=steps.numpy()),
        ]

    for name, (steps, frames) in rollout.images.items():
        pixels = frames.permute(0, 2, 3, 1).contiguous().numpy()
        size = rr.components.ImageFormat(
            width=pixels.shape[2], height=pixels.shape[1], color_model="RGB", channel_datatype="U8"
        )
        buffers = [frame.tobytes() for frame in pixels]
        columns = rr.Image.columns(buffer=buffers, format=[size] * len(buffers))
        stream.send_columns(f"camera/{name}", when(steps), columns)
    if len(rollout.states):
        states = rollout.states.double().numpy()
        turn = [_quaternion(vector) for vector in states[:, 3:6]]
        columns = rr.Transform3D.columns(translation=states[:, :3], quaternion=turn)
        stream.send_columns("world/hand", when(rollout.state_steps), columns)
        stream.set_time("time", duration=rollout.start)
        stream.set_time("step", sequence=0)
        stream.log("world/path", rr.LineStrips3D([states[:, :3]], radii=0.002))
        stream.reset_time()
    for curve in rollout.curves:
        if curve.name not in named:
            named.add(curve.name)
            stream.log(
                f"scalars/{curve.name}", rr.SeriesLines(names=list(curve.labels), colors=_colors(curve)), static=True
            )
        values, steps = curve.values.numpy(), curve.steps
        if gap:  # NaN ends the line: it does not lead on to the next rollout
            values, steps = np.pad(values, ((0, 1), (0, 0)), constant_values=np.nan), torch.cat([steps, steps[-1:]])
        columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition([values.shape[1]] * len(values))
        stream.send_columns(f"scalars/{curve.name}", when(steps), columns)
    stream.set_time("time", duration=rollout.start)
    stream.set_time("step", sequence=0)
    said = f"rollout {rollout.number}: {rollout.instruction}" + (f" -> {rollout.outcome}" if rollout.outcome else "")
    said += f" (a replay of {rollout.replayed})" if rollout.replayed else ""
    stream.log("text", rr.TextLog(said))
    stream.reset_time()


def _colors(curve: Curve) -> np.ndarray:
    plot = next((names for _, names in PLOTS if curve.name in names), (curve.name,))
    shift = plot.index(curve.name) if len(curve.labels) == 1 else 0  # single lines share a plot
    return _COLORS[(np.arange(len(curve.labels)) + shift) % len(_COLORS)]


def _quaternion(vector: np.ndarray) -> list[float]:
    """x, y, z, w of an axis-angle vector."""
    angle = float(np.linalg.norm(vector))
    axis = vector / max(angle, 1e-12)
    return [*(axis * np.sin(angle / 2)).tolist(), float(np.cos(angle / 2))]


def require_rerun() -> Any:
    """The module, if it is installed. Raises ImportError that says how to install it."""
    try:
        import rerun
    except ImportError as error:
        raise ImportError(
            f"showing recordings in Rerun needs the package rerun-sdk ({error}): pip install 'worldenv_trl[viz]', or "
            "open the file in Foxglove (--viewer foxglove)"
        ) from error
    return rerun
