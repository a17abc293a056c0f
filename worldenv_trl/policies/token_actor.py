"""The stochastic actor of policies that act by tokens: OpenVLA, and OpenVLA-OFT with its token head."""

from __future__ import annotations

import math

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Categorical, Independent
from torchrl.data.vla import ActionTokenizerBase
from torchrl.modules import ProbabilisticActor

from worldenv_trl.keys import CHUNK, LOG_PROBS, LOGITS, TOKENS

__all__ = ["IndependentCategorical", "TokenActor", "token_actor"]


class IndependentCategorical(Independent):
    """A token for each number of a chunk; the last ``event_dims`` dimensions of the tokens are one event.

    With ``logits`` ``[*B, C, A, V]``, tokens are int64 ``[*B, C, A]`` and ``log_prob`` has shape ``[*B, C, A]`` for
    ``event_dims=0`` (one ratio per token), ``[*B, C]`` for 1 (per step) and ``[*B]`` for 2.

    Examples:
        >>> import torch
        >>> distribution = IndependentCategorical(torch.zeros(5, 8, 7, 256))
        >>> distribution.log_prob(distribution.sample()).shape
        torch.Size([5, 8, 7])
    """

    def __init__(self, logits: Tensor, event_dims: int = 0, validate_args: bool | None = False) -> None:
        super().__init__(Categorical(logits=logits, validate_args=validate_args), event_dims, validate_args)

    @property
    def deterministic_sample(self) -> Tensor:
        """What TorchRL takes under ``ExplorationType.DETERMINISTIC``: the likeliest tokens."""
        return self.base_dist.logits.argmax(-1)


class _Temperature(nn.Module):
    def __init__(self, temperature: float) -> None:
        super().__init__()
        self.temperature = temperature

    def forward(self, logits: Tensor) -> Tensor:
        return logits.float() / self.temperature


class TokenActor(ProbabilisticActor):
    """``ProbabilisticActor`` over tokens that also writes the chunk they stand for; see :func:`token_actor`."""

    tokenizer: ActionTokenizerBase

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super().forward(tensordict)
        return out.set(CHUNK, self.tokenizer.decode(out.get(TOKENS)).float())


def token_actor(
    network: TensorDictModuleBase,
    tokenizer: ActionTokenizerBase,
    *,
    logits_key: NestedKey = LOGITS,
    temperature: float = 1.0,
    event_dims: int = 0,
) -> TokenActor:
    """Wraps a network that writes logits, [*B, C, 7, V].

    Writes ``TOKENS`` (sampled; the likeliest under ``ExplorationType.DETERMINISTIC``), ``CHUNK``, what the tokenizer
    decodes them to, and ``LOG_PROBS`` of the tokens. The temperature is part of the density: what is sampled from is
    what is scored. For :class:`~worldenv_trl.objectives.LOOPLoss`, tokens are the action::

        loss = LOOPLoss(actor, ratio_level="token")
        loss.set_keys(action=keys.TOKENS)

    Args:
        network: TorchRL's :class:`~torchrl.modules.vla.VLAWrapperBase` with ``action_head="tokens"`` and
            ``logits_only=True``, or any module that writes such logits.
        tokenizer: TorchRL's codec of tokens and actions. V is its ``vocab_size``.

    Keyword Args:
        logits_key: where the network writes them.
        temperature: of the exploration, positive. SimpleVLA-RL samples at 1.6.
        event_dims: see :class:`IndependentCategorical`; ``ratio_level="token"`` needs 0.

    Raises:
        ValueError: for a temperature that is not positive, or a key that the network does not write.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data.vla import VocabTailActionTokenizer
        >>> logits = TensorDictModule(nn.Linear(5, 8 * 7 * 256), in_keys=["features"], out_keys=["flat"])
        >>> shaped = TensorDictModule(lambda x: x.unflatten(-1, (8, 7, 256)), in_keys=["flat"], out_keys=[LOGITS])
        >>> actor = token_actor(TensorDictSequential(logits, shaped), VocabTailActionTokenizer(256), temperature=1.6)
        >>> out = actor(TensorDict({"features": torch.zeros(3, 5)}, [3]))
        >>> out["vla_action", "tokens"].shape, out["vla_action", "chunk"].shape, out["vla_action", "log_probs"].shape
        (torch.Size([3, 8, 7]), torch.Size([3, 8, 7]), torch.Size([3, 8, 7]))
    """
    if not (math.isfinite(temperature) and temperature > 0):
        raise ValueError(
            f"temperature must be positive, got {temperature}; for greedy actions use ExplorationType.DETERMINISTIC"
        )
    if logits_key not in network.out_keys:
        raise ValueError(f"the network writes {network.out_keys}, no {logits_key!r}: name its logits in logits_key")
    scaled = TensorDictModule(_Temperature(temperature), in_keys=[logits_key], out_keys=["logits"])
    actor = TokenActor(
        TensorDictSequential(network, scaled),
        in_keys={"logits": "logits"},
        out_keys=[TOKENS],
        distribution_class=IndependentCategorical,
        distribution_kwargs={"event_dims": event_dims},
        return_log_prob=True,
        log_prob_key=LOG_PROBS,
    )
    actor.tokenizer = tokenizer
    return actor
