"""Which camera an instruction's scene is seen through."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from worldenv_trl.robot.camera import Camera

__all__ = ["Calibrations", "check_instructions", "plain_cameras"]


def plain_cameras(cameras: Mapping[str, Mapping[str, Camera]]) -> dict[str, dict[str, dict[str, Any]]]:
    """``{camera name: {instruction: camera}}`` as a config holds it.

    Raises:
        ValueError: for anything else, such as names alone.
    """
    if not isinstance(cameras, Mapping) or not all(isinstance(each, Mapping) for each in cameras.values()):
        raise ValueError(
            f"cameras must be {{name: {{instruction: camera}}}}, for instance {{'agentview': {{task.language: "
            f"task.camera('agentview') for task in env.tasks}}}}, got {cameras!r}"
        )
    return {name: {text: asdict(camera) for text, camera in each.items()} for name, each in cameras.items()}


def check_instructions(cameras: Mapping[str, Mapping[str, Any]], config: str) -> None:
    """Raises ``ValueError`` unless a ``config`` (its name) has every camera for the same instructions, at least one."""
    texts = {tuple(each) for each in cameras.values()}
    if len(texts) != 1 or not next(iter(texts)):
        raise ValueError(
            "cameras must give every camera for the same instructions, at least one: build the config with "
            f"{config}.for_cameras({{name: {{instruction: camera}}}})"
        )


class Calibrations:
    """The distinct calibrations of one camera, and which of them an instruction's scene has."""

    def __init__(self, by_instruction: Mapping[str, Mapping[str, Any]]) -> None:
        self.distinct: list[Camera] = []
        self._index: dict[str, int] = {}
        for text, values in by_instruction.items():
            camera = Camera(**values)
            if camera not in self.distinct:
                self.distinct.append(camera)
            self._index[text] = self.distinct.index(camera)
        self._commonest = Counter(self._index.values()).most_common(1)[0][0]
        mounted = [camera.mount == "tool" for camera in self.distinct]
        self.mounted, self.any_mounted = torch.tensor(mounted, device="cpu"), any(mounted)

    def rows(self, texts: Sequence[str]) -> Iterator[tuple[Camera, Tensor]]:
        """Each calibration that scenes of these texts have, and which of them, int64 [m] on the CPU."""
        index = self.indices(texts)
        for number, camera in enumerate(self.distinct):
            rows = (index == number).nonzero().squeeze(-1)
            if len(rows):
                yield camera, rows

    def indices(self, texts: Sequence[str]) -> Tensor:
        """int64 [n], on the CPU: it is checked there, and a GPU does not wait."""
        index = [self._index.get(text, self._commonest) for text in texts]
        return torch.tensor(index, dtype=torch.int64, device="cpu")
