"""Doing what another policy does, by its means, as a TorchRL loss."""

from __future__ import annotations

from typing import ClassVar

from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives.common import LossModule

from worldenv_trl import keys
from worldenv_trl.policies import LaplaceActor

__all__ = ["DistillationLoss", "away_from"]


def away_from(mean: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    """How far means are from a reference's, in its scale, all [*B, C, 7]: [*B, C], averaged over dimensions."""
    return ((mean - loc).abs() / scale).mean(-1)


class DistillationLoss(LossModule):
    """L1 between an actor's means and a reference's at the same decisions, in units of the reference's scale.

    Policy distillation (arXiv:1511.06295) with the regression that OpenVLA-OFT's actions (arXiv:2502.19645) are trained
    by. The decisions may be shown to either in another way: imagined to the actor, real to the reference.

    Reads what the actor reads, and ``("reference", "loc")`` and ``("reference", "scale")`` [*B, C, 7]. Returns
    ``loss_distillation`` (scalar), the mean over decisions, steps and dimensions.

    Args:
        actor: trained in place; its chunks are Laplace-distributed.

    Examples:
        >>> import torch
        >>> from worldenv_trl.policies import OFTConfig, OFTPolicy, laplace_actor
        >>> actor = laplace_actor(OFTPolicy(OFTConfig(instructions=("open the drawer",))))
        >>> observation = {"image": torch.zeros(5, 3, 64, 64, dtype=torch.uint8), "state": torch.zeros(5, 7)}
        >>> decisions = TensorDict({"observation": observation, "language_instruction": "open the drawer"}, [5])
        >>> with torch.no_grad():
        ...     there = actor.get_dist(decisions.copy())
        >>> decisions["reference"] = {"loc": there.loc + there.scale, "scale": there.scale}
        >>> DistillationLoss(actor)(decisions)["loss_distillation"].item()
        1.0
    """

    actor: LaplaceActor
    out_keys: ClassVar[list[str]] = ["loss_distillation"]

    def __init__(self, actor: LaplaceActor) -> None:
        super().__init__()
        self.actor = actor

    @property
    def in_keys(self) -> list[NestedKey]:
        return [*self.actor.in_keys, keys.REFERENCE_LOC, keys.REFERENCE_SCALE]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        mean = self.actor.get_dist(tensordict.copy()).loc  # the actor writes into its copy
        away = away_from(mean, tensordict[keys.REFERENCE_LOC], tensordict[keys.REFERENCE_SCALE])
        return TensorDict({"loss_distillation": away.mean()})
