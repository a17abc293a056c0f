"""Contexts that teach: which initial states the next groups of rollouts should start from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from worldenv_trl.context_ids import UNKNOWN_CONTEXT

__all__ = ["ContextSampler"]


class ContextSampler:
    """Draws contexts by how much the returns of their rollouts are expected to differ.

    Leave-one-out advantages of a group whose rollouts all end alike are zero: it costs as much as any other and teaches
    nothing. DAPO (arXiv:2503.14476) collects such groups and drops them; here, as in prioritized level replay
    (arXiv:2010.03934), they are drawn less often, by what their earlier groups returned. Where returns are success or
    failure the score is E[p (1 - p)], the learnability of arXiv:2408.15099, p having a posterior
    Beta(prior + successes, prior + failures).

    Returns in between, of a reflector that is unsure, say more than their mean: rollouts that all return .5 do not
    differ. The posterior is therefore of the distribution of returns as a whole, a Dirichlet process with atoms of
    weight ``prior`` at 0 and at 1 before anything is seen. With m and q the means of the returns and of their squares,
    the atoms included, and n the weight of all, the expected variance of a return is n / (n + 1) (q - m^2) (Ferguson
    1973). For returns of 0 and 1 this is E[p (1 - p)].

    What was observed is weighted down with every :meth:`update`, because the policy moves on: a context that is not
    drawn any more comes to count as unseen again.

    The sampler belongs to one env: :class:`~worldenv_trl.envs.TabletopEnv` and :class:`~worldenv_trl.envs.ImaginedEnv`
    take it as ``context_sampler``, seed it with themselves and ask it at every reset. Who collects the rollouts calls
    :meth:`update` with their returns. A copy of the env, by ``deepcopy`` or in another process, draws from a copy of
    the sampler: give that the same updates, or a :meth:`state_dict` and then a seed of its own.

    Keyword Args:
        prior: weight of a success and of a failure before any is seen. By 1/4, 58 % of all groups of eight end alike;
            a context that was never drawn still counts three times as much as one whose group did.
        forgetting_factor: of each update, in (0, 1]; 1 never forgets.
        temperature: contexts are drawn with probability ~ (expected variance)^(1 / temperature), as in prioritized
            level replay; 1 in proportion.
        floor: share of the draws that is uniform, in [0, 1]: no context dies.
        seed: of the draws.

    Raises:
        ValueError: naming the argument out of bounds.

    Examples:
        >>> sampler = ContextSampler(seed=0)
        >>> sampler.update(torch.tensor([7, 8]), torch.tensor([[0.0, 1.0, 1.0, 0.0], [1.0, 1.0, 1.0, 1.0]]))
        >>> sampler.expected_variance([7, 8, 9])  # mixed, solved, never seen
        tensor([0.2045, 0.0429, 0.0833], dtype=torch.float64)
        >>> sampler.probabilities([7, 8, 9])
        tensor([0.7771, 0.0661, 0.1568], dtype=torch.float64)
        >>> sampler.draw([7, 8, 9], 2)  # places
        [2, 0]
    """

    def __init__(
        self,
        *,
        prior: float = 0.25,
        forgetting_factor: float = 0.97,
        temperature: float = 0.5,
        floor: float = 0.1,
        seed: int = 0,
    ) -> None:
        for name, value in (("prior", prior), ("temperature", temperature)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{name} must be positive, got {value}")
        if not 0 < forgetting_factor <= 1:
            raise ValueError(f"forgetting_factor must lie in (0, 1], got {forgetting_factor}")
        if not 0 <= floor <= 1:
            raise ValueError(f"floor must lie between 0 and 1, got {floor}")
        self.prior, self.forgetting_factor = prior, forgetting_factor
        self.temperature, self.floor = temperature, floor
        self._rows: dict[int, int] = {}  # of each context in the moments
        self._moments = torch.zeros(0, 3, dtype=torch.float64)  # weight, sum and sum of squares of the returns
        self.seed(seed)

    def __len__(self) -> int:
        """How many contexts have been observed."""
        return len(self._rows)

    def seed(self, seed: int) -> None:
        """Begins the draws anew; what was observed stays."""
        self._generator = torch.Generator().manual_seed(seed)

    # ------------------------------------------------------------------------------------------------- draws

    def draw(self, context_ids: Sequence[int], count: int) -> list[int]:
        """Places in ``context_ids`` [K] of ``count`` contexts, drawn one after the other without replacement; where
        ``count`` exceeds K, all of them come before any comes again.

        A function of the seed, the earlier draws and the updates.

        Raises:
            ValueError: for no context, or one without a number.
        """
        if not context_ids:
            raise ValueError("there is no context to draw: context_ids is empty")
        probabilities = self.probabilities(context_ids)
        places: list[int] = []
        while len(places) < count:
            # The first to ring of clocks with these rates are drawn so (Efraimidis and Spirakis 2006).
            rung = torch.empty_like(probabilities).exponential_(generator=self._generator) / probabilities
            places += rung.argsort()[: count - len(places)].tolist()
        return places

    def probabilities(self, context_ids: Sequence[int]) -> Tensor:
        """Of being drawn first among ``context_ids`` [K]: float64 [K]."""
        scores = self.expected_variance(context_ids)
        weights = (scores / scores.max()) ** (1 / self.temperature)
        return (1 - self.floor) * weights / weights.sum() + self.floor / len(weights)

    def expected_variance(self, context_ids: Sequence[int]) -> Tensor:
        """Of a return from each of ``context_ids`` [K], over the posterior: float64 [K]."""
        check_numbered(context_ids)
        moments = torch.zeros(len(context_ids), 3, dtype=torch.float64)
        seen = [place for place, number in enumerate(context_ids) if number in self._rows]
        moments[seen] = self._moments[[self._rows[context_ids[place]] for place in seen]]
        weight, total, squares = (moments + self.prior * torch.tensor([2.0, 1.0, 1.0])).unbind(-1)
        variance = (squares / weight - (total / weight) ** 2).clamp_min(0)  # rounding
        return weight / (weight + 1) * variance

    # ------------------------------------------------------------------------------------------------- what is known

    def update(self, context_ids: Tensor, returns: Tensor) -> None:
        """Takes note of a batch of groups, all of one policy; what earlier ones said counts less from now on.

        Args:
            context_ids: int64 [G]; a context may come more than once.
            returns: [G, N], of the rollouts that started from each.

        Raises:
            ValueError: for other shapes, a context without a number, or returns that hold NaN or infinity.
        """
        if context_ids.ndim != 1 or returns.ndim != 2 or len(context_ids) != len(returns):
            raise ValueError(
                f"update takes context_ids [G] and returns [G, N], got {list(context_ids.shape)} and "
                f"{list(returns.shape)}"
            )
        numbers = context_ids.tolist()
        check_numbered(numbers)
        returns = returns.detach().cpu().double()
        if not bool(returns.isfinite().all()):
            raise ValueError("returns hold NaN or infinity")
        for number in numbers:
            self._rows.setdefault(number, len(self._rows))
        new = torch.zeros(len(self._rows) - len(self._moments), 3, dtype=torch.float64)
        self._moments = torch.cat([self.forgetting_factor * self._moments, new])
        sums = torch.stack([torch.ones_like(returns), returns, returns.square()], -1).sum(1)  # [G, 3]
        self._moments.index_add_(0, torch.tensor([self._rows[number] for number in numbers], dtype=torch.int64), sums)

    def state_dict(self) -> dict[str, Tensor]:
        """What was observed, ``context_ids`` int64 [K] and ``moments`` float64 [K, 3], and the state of the draws."""
        return {
            "context_ids": torch.tensor(list(self._rows), dtype=torch.int64),
            "moments": self._moments.clone(),
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues where another sampler was; :meth:`seed` it afterwards for draws of its own."""
        self._rows = {number: row for row, number in enumerate(state_dict["context_ids"].tolist())}
        self._moments = state_dict["moments"].clone()
        self._generator.set_state(state_dict["generator"])


def check_numbered(context_ids: Sequence[int]) -> None:
    """Raises ``ValueError`` if one of the contexts has no number, by which its groups could be told from others."""
    if UNKNOWN_CONTEXT in context_ids:
        raise ValueError(
            f"a context sampler needs contexts with numbers, got context_id {UNKNOWN_CONTEXT}: pass context_ids"
        )
