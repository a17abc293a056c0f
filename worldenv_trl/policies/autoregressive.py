"""The stochastic actor of policies that draw tokens one after the other, and how they are taught."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from worldenv_trl.keys import CHUNK, LOG_PROBS, TOKEN_IS_PAD, TOKENS
from worldenv_trl.policies.token_actor import IndependentCategorical
from worldenv_trl.policies.token_policy import TokenPolicy

__all__ = ["AutoregressiveActor", "TeacherForcing", "token_cross_entropy"]


class AutoregressiveActor(TensorDictModuleBase):
    """Acts by the tokens of a :class:`TokenPolicy`, and tells the density that they are drawn from.

    Writes ``TOKENS`` int64 [*B, C, 7] (the likeliest under ``ExplorationType.DETERMINISTIC``), ``CHUNK``, what they
    stand for, and ``LOG_PROBS`` of the tokens. Tokens depend on those before them: :meth:`get_dist` reads ``TOKENS``,
    scores them in one pass, and its log-probabilities hold for these tokens alone. For
    :class:`~worldenv_trl.objectives.LOOPLoss` they are the action: ``loss.set_keys(action=keys.TOKENS)``. The
    temperature is part of the density: what is sampled from is what is scored.

    Of a policy that is ``sequential``, ``TOKENS`` are [*B, L], so are ``LOG_PROBS`` (0 of padding), and
    ``TOKEN_IS_PAD`` tells which of them stand behind the end.

    Args:
        policy: that acts.

    Keyword Args:
        temperature: positive; the policy's own when None.
        event_dims: 0 for a log-probability of each token [*B, C, 7], which ``ratio_level="token"`` needs, 1 for the
            steps' [*B, C]. Tokens of a whole chunk have no steps: theirs are always of each token, [*B, L].

    Raises:
        TypeError: for a policy that does not act by tokens.
        ValueError: for a temperature that is not positive, or other ``event_dims``.
    """

    policy: TokenPolicy

    def __init__(self, policy: TokenPolicy, *, temperature: float | None = None, event_dims: int = 1) -> None:
        super().__init__()
        if not isinstance(policy, TokenPolicy):
            raise TypeError(f"policy must be a worldenv_trl.policies.TokenPolicy, got {type(policy).__name__}")
        temperature = policy.temperature if temperature is None else temperature
        if not (math.isfinite(temperature) and temperature > 0):
            raise ValueError(
                f"temperature must be positive, got {temperature}; for greedy actions use ExplorationType.DETERMINISTIC"
            )
        if event_dims not in (0, 1):
            raise ValueError(f"event_dims must be 0 or 1, got {event_dims}")
        self.policy, self.temperature = policy, float(temperature)
        self.event_dims = 0 if policy.sequential else event_dims
        self.in_keys, self.out_keys = list(policy.in_keys), [TOKENS, CHUNK, LOG_PROBS]
        if policy.sequential:
            self.out_keys.append(TOKEN_IS_PAD)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        greedy = exploration_type() != ExplorationType.RANDOM
        batch, observed = self.policy.observed(tensordict)
        tokens, log_probs = self.policy.sample(*observed, self.temperature, greedy)
        tensordict.set(TOKENS, tokens.reshape(*batch, *tokens.shape[1:]))
        tensordict.set(CHUNK, self.policy.decode(tensordict[TOKENS]))
        if self.policy.sequential:
            tensordict.set(TOKEN_IS_PAD, self.policy.token_is_pad(tensordict[TOKENS]))
        if self.policy.rescored and not greedy:
            scored = self.get_dist(tensordict).log_prob(tensordict[TOKENS])
            if self.policy.sequential:
                scored = scored.masked_fill(tensordict[TOKEN_IS_PAD], 0.0)
        else:
            scored = log_probs.sum(-1) if self.event_dims else log_probs
            scored = scored.reshape(*batch, *scored.shape[1:])
        return tensordict.set(LOG_PROBS, scored)

    def get_dist(self, tensordict: TensorDictBase) -> IndependentCategorical:
        """The density of every token given those before it, which the TensorDict has to hold.

        Raises:
            RuntimeError: for a policy that cannot learn.
        """
        self.policy.require_gradients()
        logits = _teacher_forced(self.policy, tensordict)
        return IndependentCategorical(logits / self.temperature, self.event_dims)


class TeacherForcing(TensorDictModuleBase):
    """Logits of given tokens, each after the given ones before it, as TorchRL's ``BCLoss`` takes them.

    Reads what the policy reads and ``TOKENS`` [*B, C, 7]. The loss looks for a prediction where the expert's action
    was: logits [*B, C, 7, V] take the place of the tokens::

        loss = BCLoss(TeacherForcing(policy), loss_function=token_cross_entropy)
        loss.set_keys(action=keys.TOKENS, pad_mask=keys.ACTION_IS_PAD)

    Tokens of a whole chunk are [*B, L], and ``keys.TOKEN_IS_PAD`` is their mask.

    Args:
        policy: that is taught.
    """

    def __init__(self, policy: TokenPolicy) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = [*policy.in_keys, TOKENS], [TOKENS]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(TOKENS, _teacher_forced(self.policy, tensordict))


def token_cross_entropy(logits: Tensor, tokens: Tensor) -> Tensor:
    """Of each token: float32 [*B] of logits [*B, V] and tokens [*B].

    Examples:
        >>> token_cross_entropy(torch.zeros(2, 8, 7, 256), torch.zeros(2, 8, 7, dtype=torch.int64)).shape
        torch.Size([2, 8, 7])
    """
    return F.cross_entropy(logits.flatten(0, -2), tokens.flatten(), reduction="none").reshape(tokens.shape)


def _teacher_forced(policy: TokenPolicy, tensordict: TensorDictBase) -> Tensor:
    _batch, observed = policy.observed(tensordict)
    tokens = tensordict[TOKENS]
    logits = policy.logits(*observed, tokens.reshape(-1, *policy.token_shape))
    return logits.reshape(*tokens.shape, logits.shape[-1])
