"""What a reflector learns from, as a TorchRL loss (World-Env section 3.3)."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDict, TensorDictBase
from torchrl.objectives.common import LossModule

from worldenv_trl.reflectors import Reflector

__all__ = ["ReflectorLoss"]


class ReflectorLoss(LossModule):
    """The reflector's own loss of a batch that one of its lessons drew, whatever it reads.

    Returns ``loss_reflector`` (scalar) and the detached ``accuracy`` at 0.5.

    Args:
        reflector: trained in place.

    Raises:
        TypeError: when called, for a reflector that has no lessons.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig
        >>> loss = ReflectorLoss(CompactReflector(CompactReflectorConfig(("open the drawer",))))
        >>> batch = TensorDict({"words": torch.tensor([[4, 2, 3]] * 5), "label": torch.ones(5, 1, dtype=torch.bool),
        ...                     "features": torch.randn(5, 6, 96), "lengths": torch.full((5, 1), 6)}, batch_size=[5])
        >>> sorted(loss(batch).keys())
        ['accuracy', 'loss_reflector']
    """

    reflector: Reflector
    in_keys: ClassVar[list[str]] = []
    out_keys: ClassVar[list[str]] = ["loss_reflector", "accuracy"]

    def __init__(self, reflector: Reflector) -> None:
        super().__init__()
        self.reflector = reflector

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        return self.reflector.training_loss(tensordict).select(*self.out_keys)
