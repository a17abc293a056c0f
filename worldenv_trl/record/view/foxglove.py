"""Recordings in Foxglove, which opens the files as they are: a layout that shows what is in them."""

from __future__ import annotations

import copy
import json
import os
import re
import warnings
from importlib.resources import files
from typing import Any

from worldenv_trl.record.mcap.provenance import replayed_from
from worldenv_trl.record.mcap.reader import _require_file
from worldenv_trl.record.mcap.recording import Recording

__all__ = ["foxglove_layout", "foxglove_paths"]

_PATH = re.compile(r"(/[\w/]+)\.(\w+)(?:\[(\d+)\])?")
_CAMERA = re.compile(r"(?:/layout_\d+)?/(observation|recorded)/.*(?<!/after_stop)$")


def foxglove_layout(path: str | os.PathLike | None = None) -> dict[str, Any]:
    """The layout that ships with this package, as Foxglove imports it; for ``path``, what that recording holds of it.

    Panels and plotted values of topics and fields that the recording lacks are left out, so that none shows an error;
    cameras that the layout does not know get a panel, too. A replay's camera says what it is a replay of.
    A warning says of a file that it was cut off or damaged: Foxglove may show less than :func:`read_rollouts` reads.

    Raises:
        FileNotFoundError, ValueError: as :func:`~worldenv_trl.record.read_rollouts`.
    """
    layout = json.loads(files("worldenv_trl.record.view").joinpath("foxglove_layout.json").read_text())
    if path is None:
        return layout
    recording = Recording(_require_file(path))
    if not recording.scan.intact:
        warnings.warn(
            f"{path} {recording.scan.losses[0]}: Foxglove may show less of it than recipes/repair.py rescues",
            stacklevel=2,
        )
    have = _paths(recording)
    panels = layout["configById"]
    shown = {panel["imageMode"]["imageTopic"] for name, panel in panels.items() if name.startswith("Image!")}
    for topic in sorted(have):
        if _CAMERA.match(topic) and topic not in shown and not have[topic]:
            _add_camera(layout, topic)
    for name, panel in list(panels.items()):
        kind = name.partition("!")[0]
        if kind == "Plot":
            panel["paths"] = [line for line in panel["paths"] if _present(line["value"], have)]
            keep = bool(panel["paths"])
        elif kind == "Image":
            keep = panel["imageMode"]["imageTopic"] in have
        elif kind == "RosOut":
            keep = panel["topicToRender"] in have
        else:
            keep = True
        if not keep:
            del panels[name]
    layout["layout"] = _pruned(layout["layout"], set(panels))
    replayed = replayed_from(recording.metadata)
    if replayed and "Image!camera" in panels:
        panels["Image!camera"]["foxglovePanelTitle"] = f"replay of {replayed}"
    return layout


def _add_camera(layout: dict[str, Any], topic: str) -> None:
    """An image panel for a topic, beside the camera's."""
    panel = copy.deepcopy(layout["configById"]["Image!camera"])
    panel["foxglovePanelTitle"] = topic.strip("/").replace("observation/", "").replace("/", " ")
    panel["imageMode"]["imageTopic"] = topic
    name = "Image!" + re.sub(r"\W", "", topic)
    layout["configById"][name] = panel
    layout["layout"] = _beside(layout["layout"], "Image!camera", name)


def _beside(tree: Any, panel: str, other: str) -> Any:
    """The arrangement with another panel at the side of one."""
    if isinstance(tree, str):
        pair = {"first": panel, "second": other, "direction": "row", "splitPercentage": 50}
        return pair if tree == panel else tree
    return tree | {side: _beside(tree[side], panel, other) for side in ("first", "second")}


def foxglove_paths(path: str | os.PathLike) -> dict[str, dict[str, int]]:
    """The topics of a recording, with how many values each plottable field has: ``{"/step": {"reward": 1}}``."""
    return _paths(Recording(_require_file(path)))


def _paths(recording: Recording) -> dict[str, dict[str, int]]:
    for chunk in recording.scan.chunks:  # a file that was cut off names its channels in its chunks only
        if not recording.scan.channels or not recording.scan.intact:
            for _ in recording.scan.messages(chunk):
                break
    out: dict[str, dict[str, int]] = {channel.topic: {} for channel in recording.scan.channels.values()}
    layouts = [(part.layout, part.prefix) for part in recording.written] + recording.streams
    for layout, prefix in layouts:
        out.setdefault(f"{prefix}/step", {}).update({entry.field: entry.count for entry in layout.numbers})
    for topic, layout in recording._annotations.items():
        out.setdefault(topic, {}).update({entry.field: entry.count for entry in layout.numbers})
    return out


def _present(value: str, have: dict[str, dict[str, int]]) -> bool:
    found = _PATH.fullmatch(value)
    if found is None:
        return False
    topic, field, index = found.groups()
    return int(index or 0) < have.get(topic, {}).get(field, 0)


def _pruned(tree: Any, panels: set[str]) -> Any:
    """The arrangement without the panels that are gone."""
    if isinstance(tree, str):
        return tree if tree in panels else None
    first, second = _pruned(tree["first"], panels), _pruned(tree["second"], panels)
    if first is None or second is None:
        return first if second is None else second
    return tree | {"first": first, "second": second}
