from __future__ import annotations

import pytest
import torch
from small_rollouts import CAMERAS, make_episodes
from tensordict import TensorDict

from worldenv_trl.data import score_episodes
from worldenv_trl.reflectors import Reflector


class Reddest(Reflector):
    """The most of its cameras' red that was ever seen, of 255, and a little more for each letter of the goal."""

    def begin(self, frames, instructions):
        letters = torch.tensor([len(text) / 100 for text in instructions])
        score = self._red(frames) + letters
        return TensorDict({"score": score, "letters": letters}, batch_size=[len(score)])

    def extend(self, state, frames):
        red = self._red(frames) + state["letters"].unsqueeze(-1)  # [n, C]
        scores = torch.cat([state["score"].unsqueeze(-1), red], 1).cummax(1).values[:, 1:]
        state = state.clone()
        state["score"] = scores[:, -1]
        return state, scores

    def _red(self, frames):
        return sum(frames[camera][..., 0, 0, 0].float() / 255 for camera in self.cameras)


@pytest.mark.parametrize("rows_at_once", [1, 2, 16])
def test_every_frame_has_the_score_of_what_was_seen_until_then(rows_at_once):
    episodes = make_episodes([3, 5, 1])
    episodes.video[0]["frames", "image"][1, 0] = 200  # the second frame of the first episode
    scores = score_episodes(Reddest(cameras=CAMERAS), episodes, rows_at_once=rows_at_once)
    assert scores.shape == (3, 6)
    for row, length in enumerate((3, 5, 1)):
        most = 0.0
        for step in range(6):
            number = torch.tensor(min(step, length))
            seen = [float(episodes.frames(c, torch.tensor(row), number)[0, 0, 0]) for c in CAMERAS]
            most = max(most, sum(seen) / 255)
            assert float(scores[row, step]) == pytest.approx(most + len(f"goal {row}") / 100, abs=1e-5)


def test_only_the_reflectors_cameras_are_looked_at():
    episodes = make_episodes([3])
    scores = score_episodes(Reddest(cameras=["wrist"]), episodes)
    assert torch.allclose(scores, (7 + torch.arange(4.0)) / 255 + 0.06)


def test_scores_need_no_gradient():
    assert not score_episodes(Reddest(cameras=CAMERAS), make_episodes([2])).requires_grad


def test_what_is_no_probability_is_refused():
    episodes = make_episodes([3])
    episodes.video[0]["frames", "image"][2] = 255
    with pytest.raises(ValueError, match=r"Reddest.extend: scores must be probabilities, in \[0, 1\], got 1\.0"):
        score_episodes(Reddest(cameras=CAMERAS), episodes)
