"""One text for each row of an env, cheap to carry through a rollout."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NonTensorData, NonTensorStack

__all__ = ["RowTexts", "row_texts"]


class RowTexts(NonTensorStack):
    """A stack of texts that never change: copies share them, where TensorDict's own copies text by text, every step."""

    def _clone(self, recurse: bool = True) -> RowTexts:
        return type(self)(*self.tensordicts, stack_dim=self.stack_dim, stack_dim_name=self._td_dim_name)


def row_texts(texts: Sequence[str], device: torch.device) -> NonTensorData | RowTexts:
    """``texts`` as non-tensor data with batch size ``[len(texts)]``."""
    if len(set(texts)) == 1:
        return NonTensorData(texts[0], batch_size=[len(texts)], device=device)
    return RowTexts(*(NonTensorData(text, device=device) for text in texts))
