"""The objective of any world model, whatever the model learns."""

from __future__ import annotations

import pytest
import torch
from swaps.copying_world_model import CopyingConfig, CopyingWorldModel
from tensordict import TensorDict
from torch import nn

from worldenv_trl.objectives import WorldModelLoss


class Guess(CopyingWorldModel):
    """Learns one number: the mean action."""

    def __init__(self) -> None:
        super().__init__(CopyingConfig(image_size=8, chunk_length=4))
        self.guess = nn.Parameter(torch.zeros(()))

    def training_loss(self, windows):
        error = windows["actions"] - self.guess
        return TensorDict({"loss_world_model": error.square().mean(), "bias": error.detach().mean()})


def windows() -> TensorDict:
    return TensorDict({"actions": torch.full((2, 4, 7), 0.5)}, batch_size=[2])


def test_the_loss_is_what_the_world_model_itself_wants():
    out = WorldModelLoss(Guess())(windows())
    assert out["loss_world_model"].item() == 0.25 and out["bias"].item() == 0.5


def test_the_model_is_trained_in_place():
    model = Guess()
    loss = WorldModelLoss(model)
    assert [parameter is model.guess for parameter in loss.parameters()] == [True]
    loss(windows())["loss_world_model"].backward()
    assert model.guess.grad.item() == -1.0


def test_a_model_that_does_not_learn_is_named():
    with pytest.raises(TypeError, match="CopyingWorldModel is not trained"):
        WorldModelLoss(CopyingWorldModel())(windows())
