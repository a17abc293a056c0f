"""The running mean of a policy's weights, drawn back towards those it began with; only what learns is held again."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from worldenv_trl.policies import Policy


class RunningMean:
    """A policy with the running mean of another one's weights, or one between that mean and where the other one began.

    Weights between those before and after fine-tuning keep what either knows (Wortsman et al., "Robust fine-tuning of
    zero-shot models", 2022; Ramé et al., "WARP: on the benefits of weight averaged rewarded policies", 2024): what
    learning broke far from its data is mended, at a part of what it gained. Frozen parameters and buffers are those of
    the other policy, not copies: a mean of what stays is what it is.

    Args:
        policy: what learns, and goes on learning in place; its weights now are the source.
        decay: of the mean, in [0, 1], for each :meth:`update`; after the first one it is the policy itself.
        source_share: of the source in each parameter of the result, in [0, 1]; the mean has the rest. A low-rank
            adapter's two factors are mixed each for itself, so their product is not the mix of the products.

    Attributes:
        policy: with these weights; to act with and to save, not to train.
    """

    def __init__(self, policy: Policy, decay: float, source_share: float = 0.0) -> None:
        self._learns = nn.ParameterList(each for each in policy.parameters() if each.requires_grad)
        self._mean = AveragedModel(self._learns, multi_avg_fn=get_ema_multi_avg_fn(decay))
        self._share = source_share
        # Without a share nothing stands between the mean and the result: no copy, and its very bits.
        self._source = copy.deepcopy(self._learns) if source_share else None
        self._result = copy.deepcopy(self._learns) if source_share else self._mean.module
        known: dict[int, Any] = {id(each): each for each in (*policy.parameters(), *policy.buffers())}
        known |= {id(own): each for own, each in zip(self._learns, self._result.parameters(), strict=True)}
        self.policy: Policy = copy.deepcopy(policy, known)

    def update(self) -> None:
        """Takes in the weights that are reached now."""
        self._mean.update_parameters(self._learns)
        self._draw_back()

    @torch.no_grad()
    def _draw_back(self) -> None:
        if self._source is None:
            return
        for result, mean, source in zip(
            self._result.parameters(), self._mean.module.parameters(), self._source.parameters(), strict=True
        ):
            result.copy_(torch.lerp(mean, source, self._share))

    def state_dict(self) -> dict[str, Any]:
        """Of what learns, and the number of updates; the source is what it was made with."""
        return self._mean.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._mean.load_state_dict(state_dict)
        self._draw_back()
