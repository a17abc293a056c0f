"""What was recorded, laid beside each step of a replay, so that a viewer shows and plots both."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import Tensor

from worldenv_trl.keys import FRAMES, STATE, SUCCESS, SUCCESS_PROB
from worldenv_trl.record.replay.source import image_entries, steps_around

__all__ = ["laid_beside"]

_PLOTTED = ((SUCCESS,), (SUCCESS_PROB,), STATE)
_EQUAL_DB = 100.0  # of equal frames, whose PSNR is infinite: no viewer plots that


def laid_beside(
    played: TensorDict, recorded: Mapping[str, tuple[Tensor, Tensor]], first_step: int, psnr: Mapping[int, float]
) -> TensorDict:
    """Entries [T] of a replay, and below ``("next", "recorded")`` what the recording shows at the same env steps.

    Of each camera the image, of decisions in ``frames`` at each of their C steps, and the ``psnr`` [T, C] of what was
    played; ``success``, ``success_prob`` and ``state`` where both have them, after the last step of each entry. Where
    the recording has ended, its last value.

    Args:
        played: the replay.
        recorded: what :func:`~worldenv_trl.record.replay.source.observed` gives of the recording.
        first_step: env steps before the replay.
        psnr: dB, by env step.
    """
    out, have = played.copy(), set(played.keys(True, True))
    for name in image_entries(played):
        if name not in recorded or ("next", "observation", name) not in have:
            continue
        steps, images = recorded[name]
        chunk = played["next", FRAMES, name].shape[1] if ("next", FRAMES, name) in have else 1
        shown = first_step + 1 + torch.arange(len(played) * chunk)  # the steps of the played images
        shape = (len(played),) if chunk == 1 else (len(played), chunk)
        key = (name,) if chunk == 1 else (FRAMES, name)
        out["next", "recorded", *key] = images[_last_known(steps, shown)].reshape(*shape, *images.shape[1:])
        decibels = torch.tensor([min(psnr.get(step, float("nan")), _EQUAL_DB) for step in shown.tolist()])
        out["next", "recorded", "psnr"] = decibels.reshape(len(played), chunk)
    after = steps_around(played, first_step)[1]
    for path in _PLOTTED:
        if path[-1] in recorded and ("next", *path) in have:
            steps, values = recorded[path[-1]]
            out["next", "recorded", path[-1]] = values[_last_known(steps, after)]
    return out


def _last_known(steps: Tensor, wanted: Tensor) -> Tensor:
    """Places in ``steps`` [n] of the last one up to each that is wanted."""
    return (torch.searchsorted(steps, wanted, right=True) - 1).clamp(min=0)
