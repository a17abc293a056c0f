"""The running mean of a policy's weights; only what learns is held again."""

from __future__ import annotations

import copy
from typing import Any

from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from worldenv_trl.policies import Policy


class RunningMean:
    """A policy with the running mean of another one's weights.

    Frozen parameters and buffers are those of the other policy, not copies: a mean of what stays is what it is.

    Args:
        policy: what learns, and goes on learning in place.
        decay: of the mean, in [0, 1], for each :meth:`update`; after the first one it is the policy itself.

    Attributes:
        policy: with these weights; to act with and to save, not to train.
    """

    def __init__(self, policy: Policy, decay: float) -> None:
        self._learns = nn.ParameterList(each for each in policy.parameters() if each.requires_grad)
        self._mean = AveragedModel(self._learns, multi_avg_fn=get_ema_multi_avg_fn(decay))
        known: dict[int, Any] = {id(each): each for each in (*policy.parameters(), *policy.buffers())}
        known |= {id(own): each for own, each in zip(self._learns, self._mean.module.parameters(), strict=True)}
        self.policy: Policy = copy.deepcopy(policy, known)

    def update(self) -> None:
        """Takes in the weights that are reached now."""
        self._mean.update_parameters(self._learns)

    def state_dict(self) -> dict[str, Any]:
        """Of what learns, and the number of updates."""
        return self._mean.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._mean.load_state_dict(state_dict)
