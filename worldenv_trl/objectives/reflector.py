"""Binary cross-entropy of the reflector (World-Env section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from worldenv_trl import keys
from worldenv_trl.reflectors import Reflector

__all__ = ["ReflectorLoss"]


class ReflectorLoss(LossModule):
    """BCE of R(o_1:t, g) against whether the goal holds at frame t.

    Reads ``features`` [P, L, F] of sampled prefixes, ``lengths`` int64 [P, 1], ``task_id`` [P, 1] and ``label`` bool
    [P, 1]. Returns ``loss_reflector`` (scalar) and the detached ``accuracy`` at 0.5.

    Args:
        reflector: its reward head is trained in place; the encoder is not touched.

    Keyword Args:
        label_smoothing: labels become ``s / 2`` and ``1 - s / 2``.
    """

    @dataclass
    class _AcceptedKeys:
        features: NestedKey = "features"
        lengths: NestedKey = "lengths"
        label: NestedKey = "label"

    default_keys = _AcceptedKeys
    reflector: Reflector
    out_keys: ClassVar[list[str]] = ["loss_reflector", "accuracy"]

    def __init__(self, reflector: Reflector, *, label_smoothing: float = 0.0) -> None:
        super().__init__()
        if not 0 <= label_smoothing < 1:
            raise ValueError(f"label_smoothing must be in [0, 1), got {label_smoothing}")
        self.reflector, self.label_smoothing = reflector, float(label_smoothing)
        self._forward_value_estimator_keys()

    def _forward_value_estimator_keys(self, **_: object) -> None:
        names = self.tensor_keys
        self.in_keys = [names.features, names.lengths, keys.TASK_ID, names.label]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        names = self.tensor_keys
        logits = self.reflector.logits(
            tensordict[names.features], tensordict[names.lengths].squeeze(-1), tensordict[keys.TASK_ID]
        )
        label = tensordict[names.label].squeeze(-1)
        target = label.float() * (1 - self.label_smoothing) + self.label_smoothing / 2
        loss = F.binary_cross_entropy_with_logits(logits, target)
        with torch.no_grad():
            accuracy = ((logits > 0) == label).float().mean()
        return TensorDict({"loss_reflector": loss, "accuracy": accuracy})
