"""The training objective of any world model."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDictBase
from torchrl.objectives.common import LossModule

from worldenv_trl.world_models import WorldModel

__all__ = ["WorldModelLoss"]


class WorldModelLoss(LossModule):
    """What the world model itself wants to be trained on: its ``training_loss`` of windows.

    Reads windows as :func:`~worldenv_trl.data.window_buffer` draws them. Returns ``loss_world_model`` (scalar) and the
    model's own detached figures.

    Args:
        world_model: trained in place; no functional copy of its parameters is made.
    """

    world_model: WorldModel
    out_keys: ClassVar[list[str]] = ["loss_world_model"]

    def __init__(self, world_model: WorldModel) -> None:
        super().__init__()
        self.world_model = world_model
        self.in_keys = ["frames", "poses", "number", "start", "actions", "step_mask", "language_instruction"]

    def _forward_value_estimator_keys(self, **_: object) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.world_model.training_loss(tensordict)
