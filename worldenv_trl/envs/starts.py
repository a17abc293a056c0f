"""Where the rollouts of a wave begin, drawn by one env and given to another."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

__all__ = ["GivenStarts"]


class GivenStarts:
    """Of an env whose ``draw_starts()`` draws what its next reset of all rows would begin with."""

    batch_size: torch.Size
    _starts: TensorDictBase | None = None

    def begin_with(self, starts: TensorDictBase) -> None:
        """Lets the next reset of all rows begin with ``starts``, of this env's ``draw_starts`` or another's of the same
        tasks and initial states or contexts: of all its groups, or of some whole ones.

        Raises:
            ValueError: if they are not of this env's batch size.
        """
        if starts.batch_size != self.batch_size:
            raise ValueError(f"starts must be {list(self.batch_size)}, got {list(starts.batch_size)}")
        self._starts = starts

    def _given_starts(self) -> TensorDictBase | None:
        """Those of the reset that asks, once."""
        given, self._starts = self._starts, None
        return given
