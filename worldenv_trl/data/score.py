"""What a reflector makes of whole episodes."""

from __future__ import annotations

import torch
from torch import Tensor

from worldenv_trl.data.episodes import Episodes
from worldenv_trl.devices import device_of
from worldenv_trl.keys import KINEMATIC_STATES
from worldenv_trl.reflectors import Reflector
from worldenv_trl.reflectors.base import check_scores

__all__ = ["score_episodes"]


@torch.no_grad()
def score_episodes(reflector: Reflector, episodes: Episodes, *, rows_at_once: int = 16) -> Tensor:
    """R(o_1:t, g) of every frame, [R, T + 1]; past the end of an episode its last frame goes on.

    Frames go to the reflector's device some rows at a time; scores come back.

    Keyword Args:
        rows_at_once: episodes whose frames are in memory at a time.

    Raises:
        ValueError: for episodes that do not show the reflector's cameras at its size; when scores are not of the
            videos' frames, or no probabilities.
    """
    episodes.require("the reflector", reflector.cameras, reflector.image_size)
    steps = torch.arange(1, episodes["actions"].shape[1] + 1)
    device, parts = device_of(reflector), []

    def shown(rows: Tensor, steps: Tensor) -> dict[str, Tensor]:
        looked_at = reflector.cameras if reflector.reads_video or not steps.any() else ()
        frames = {camera: episodes.frames(camera, rows, steps).to(device) for camera in looked_at}
        if reflector.reads_path:
            frames[KINEMATIC_STATES] = episodes["kinematic_states"][rows, steps].to(device)
        return frames

    for start in range(0, len(episodes), rows_at_once):
        rows = torch.arange(start, min(start + rows_at_once, len(episodes)))
        state = reflector.begin(
            shown(rows, torch.zeros_like(rows)), [episodes.instructions[row] for row in rows.tolist()]
        )
        start_score = state["score"].clone()
        check_scores(reflector, "begin", start_score, (len(rows),))
        _, scores = reflector.extend(state, shown(rows.unsqueeze(-1), steps))
        check_scores(reflector, "extend", scores, (len(rows), len(steps)))
        parts.append(torch.cat([start_score.unsqueeze(-1), scores], 1).cpu())
    return torch.cat(parts)
