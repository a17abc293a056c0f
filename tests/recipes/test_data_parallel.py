"""Training in one process: a loss that says nothing is not learned from."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from command_line import expected
from data_parallel import DataParallel


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("backward", ["mean", "sum"])
def test_a_loss_that_is_not_finite_ends_the_training_before_the_gradients(bad, backward):
    part = nn.Linear(1, 1)
    learner = DataParallel(part, lambda each: lambda batch: {"loss": each(batch["x"]).mean()})
    value = learner(TensorDict({"x": torch.tensor([[bad]])}, [1]))["loss"]
    with pytest.raises(ValueError, match=r"the loss is (nan|-?inf): lower the stage's learning rate") as raised:
        learner.backward_mean(value, 1) if backward == "mean" else learner.backward_sum(value)
    assert expected(raised.value) and part.weight.grad is None
