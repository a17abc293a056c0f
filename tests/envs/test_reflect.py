"""Reward and stop by a reflector whose scores are written by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import ImaginedEnv, Reflect, TabletopEnv, chunked
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.reflectors import Reflector

TASK = "starter/open_the_top_drawer"


class Brightness(Reflector):
    """Scores a prefix by the red of its last frame's first pixel; remembers how many frames it encoded."""

    feature_dim = 1

    def __init__(self) -> None:
        super().__init__()
        self.encoded = 0

    def encode(self, frames: Tensor) -> Tensor:
        self.encoded += len(frames)
        return frames[:, 0, 0, :1].float() / 255

    def logits(self, features: Tensor, lengths: Tensor, task_id: Tensor) -> Tensor:
        last = features[torch.arange(len(features)), lengths - 1, 0]
        return torch.logit(last.clamp(0.001, 0.999))


class Film(torch.nn.Module):
    """A world model that plays a fixed film: ``brightness[context][t]`` is the red of frame t."""

    chunk_length = 4

    def __init__(self, brightness: Tensor) -> None:
        super().__init__()
        self.brightness = brightness

    def memory_indices(self, t: Tensor) -> Tensor:
        return t.unsqueeze(-1)

    def forward(self, td: TensorDict) -> TensorDict:
        frames = torch.zeros(len(td), 4, 3, 16, 16, dtype=torch.uint8)
        time = td["memory", "frames"][:, 0, 2, 0, 0].long()  # blue counts the frames
        film = td["memory", "reference"][:, 1, 0, 0].long()  # green names the film
        for k in range(4):
            frames[:, k, 0, 0, 0] = self.brightness[film, (time + k + 1).clamp(max=self.brightness.shape[1] - 1)]
            frames[:, k, 2, 0, 0] = (time + k + 1).to(torch.uint8)
        return td.set(keys.FRAMES, frames)


def imagined(brightness: list[list[int]], **settings):
    film = torch.tensor([[0, *row] for row in brightness], dtype=torch.uint8)
    physics = TabletopEnv(TASK, len(film), image_size=16, init_state_mode="cycle", proprio="commanded", num_threads=1)
    contexts = physics.reset()
    physics.close()
    contexts[keys.IMAGE] = torch.zeros_like(contexts[keys.IMAGE])
    contexts["observation", "image"][:, 1, 0, 0] = torch.arange(len(film), dtype=torch.uint8)
    env = ImaginedEnv(
        Film(film), ForwardKinematics(), contexts, [len(film), 1], max_steps=film.shape[1] - 1, chunk_length=4, seed=0
    )
    return TransformedEnv(env, Reflect(Brightness(), **settings))


def roll(env):
    policy = lambda td: td.set(keys.CHUNK, torch.zeros(*env.batch_size, 4, 7))  # noqa: E731
    wave = next(iter(GroupCollector(env, policy, groups_per_batch=env.batch_size[0])))[:, 0]
    return wave[wave[keys.CONTEXT_ID][:, 0, 0].argsort()]


def executed(wave):
    return (wave["next", keys.STEP_MASK] & wave[keys.MASK][..., None]).sum((-2, -1)).tolist()


def last(wave, key):
    steps = wave[keys.MASK].sum(-1) - 1
    return wave["next"][key][torch.arange(len(wave)), steps]


def test_the_first_crossing_ends_a_row_inside_the_chunk_with_its_score_as_the_reward():
    env = imagined([[10, 20, 30, 40, 50, 200, 250, 250], [10] * 8])
    wave = roll(env)
    assert executed(wave) == [6, 8]
    assert last(wave, "terminated").squeeze(-1).tolist() == [True, False]
    assert last(wave, "truncated").squeeze(-1).tolist() == [False, True]
    torch.testing.assert_close(wave["returns"][:, 0], torch.tensor([200 / 255, 10 / 255]))
    assert last(wave, keys.IMAGE)[0, 0, 0, 0] == 200  # the crossing frame, not the chunk's last
    assert last(wave, keys.NUM_STEPS).squeeze(-1).tolist() == [6, 8]
    torch.testing.assert_close(last(wave, keys.STATE)[0], last(wave, keys.STATES)[0, 1])


def test_reward_is_zero_before_the_end():
    wave = roll(imagined([[10, 20, 30, 40, 50, 60, 70, 80]]))
    assert wave["next", "reward"].squeeze(-1).tolist() == [[0.0, pytest.approx(80 / 255)]]


def test_consecutive_frames_must_cross_also_over_the_seam_of_two_chunks():
    film = [200, 10, 200, 200, 200, 10, 10, 10]
    assert executed(roll(imagined([film], consecutive=3))) == [5]
    assert executed(roll(imagined([film], consecutive=1))) == [1]
    assert executed(roll(imagined([film], consecutive=4))) == [8]


def test_the_threshold_is_exclusive_and_can_be_moved():
    assert executed(roll(imagined([[10, 102, 204, 204, 10, 10, 10, 10]], threshold=0.7))) == [3]
    assert executed(roll(imagined([[10, 102, 204, 204, 10, 10, 10, 10]], threshold=0.9))) == [8]


def test_finished_rows_are_not_encoded_again():
    env = imagined([[200] + [10] * 7, [10] * 8])
    roll(env)
    reflector = env.transform.reflector if hasattr(env.transform, "reflector") else env.transform[0].reflector
    assert reflector.encoded == 2 + 2 * 4 + 1 * 4  # first frames, one chunk of both rows, one of the row that runs


def test_specs_hold_over_both_environments():
    check_env_specs(imagined([[10] * 8, [20] * 8]))
    env = TabletopEnv(TASK, 2, image_size=16, terminate_on_success=False, num_threads=1)
    check_env_specs(chunked(TransformedEnv(env, Reflect(Brightness())), 4))


def test_over_the_physics_a_stop_leaves_the_rest_of_the_chunk_unexecuted():
    class AtTheThirdFrame(Brightness):
        def encode(self, frames: Tensor) -> Tensor:
            self.encoded += len(frames)
            return torch.full((len(frames), 1), 0.9 if self.encoded > 2 * 3 else 0.1)

    env = TabletopEnv(TASK, 2, image_size=16, terminate_on_success=False, max_steps=8, num_threads=1)
    env = chunked(TransformedEnv(env, Reflect(AtTheThirdFrame())), 4)
    td = env.reset()
    td = env.step(td.set(keys.CHUNK, torch.zeros(2, 4, 7)))
    assert td["next", keys.STEP_MASK].tolist() == [[True, True, True, False]] * 2
    assert td["next", "terminated"].all()
    torch.testing.assert_close(td["next", "reward"], torch.full((2, 1), 0.9))
    assert td["next", keys.NUM_STEPS].squeeze(-1).tolist() == [3, 3]


class Length(Brightness):
    """Scores a prefix by the number of its frames that are looked at: a tenth each."""

    def logits(self, features: Tensor, lengths: Tensor, task_id: Tensor) -> Tensor:
        return torch.logit(lengths / 10)


def test_a_partial_reset_forgets_the_video_of_the_reset_rows_only():
    env = TabletopEnv(TASK, 2, image_size=16, terminate_on_success=False, max_steps=8, num_threads=1)
    env = TransformedEnv(env, Reflect(Length(), threshold=0.95))
    td = env.reset()
    torch.testing.assert_close(td[keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.1, 0.1]))
    for _ in range(2):
        td = env.step_mdp(env.step(td.set(keys.ACTION, torch.zeros(2, 7))))
    td["_reset"] = torch.tensor([[True], [False]])
    td = env.reset(td)
    torch.testing.assert_close(td[keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.1, 0.3]))
    td = env.step(td.set(keys.ACTION, torch.zeros(2, 7)))
    torch.testing.assert_close(td["next", keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.2, 0.4]))
    env.close()


def test_rows_that_are_not_stepped_keep_their_video_and_score():
    env = TabletopEnv(TASK, 2, image_size=16, terminate_on_success=False, max_steps=8, num_threads=1)
    env = TransformedEnv(env, Reflect(Length(), threshold=0.95))
    td = env.reset().set(keys.ACTION, torch.zeros(2, 7))
    td["_step"] = torch.tensor([True, False])
    td = env.step_mdp(env.step(td))
    td["_step"] = torch.tensor([True, True])
    td = env.step(td.set(keys.ACTION, torch.zeros(2, 7)))
    torch.testing.assert_close(td["next", keys.SUCCESS_PROB].squeeze(-1), torch.tensor([0.3, 0.2]))
    env.close()


def test_fewer_frames_of_a_prefix_can_be_looked_at_and_the_reflector_itself_is_not_changed():
    reflector = Length()
    env = TabletopEnv(TASK, 1, image_size=16, terminate_on_success=False, max_steps=8, num_threads=1)
    env = TransformedEnv(env, Reflect(reflector, threshold=0.95, num_frames=2))
    scores = env.rollout(4, lambda td: td.set(keys.ACTION, torch.zeros(1, 7)))["next", keys.SUCCESS_PROB]
    torch.testing.assert_close(scores.flatten(), torch.full((4,), 0.2))
    assert reflector.num_frames == Reflector.num_frames == 32
    env.close()


def test_the_crossing_frame_ends_a_row_also_when_it_is_the_last_step_that_was_left():
    wave = roll(imagined([[10, 20, 30, 40, 50, 60, 70, 250]]))
    assert last(wave, "terminated").tolist() == [[True]]
    assert last(wave, "truncated").tolist() == [[False]]


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"threshold": 1.0}, "got 1.0"), ({"consecutive": 0}, "got 0"), ({"num_frames": 1}, "got 1")],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Reflect(Brightness(), **settings)


class Average(Brightness):
    """Scores a prefix by the mean of all its frames."""

    def logits(self, features: Tensor, lengths: Tensor, task_id: Tensor) -> Tensor:
        inside = torch.arange(features.shape[1]) < lengths.unsqueeze(-1)
        mean = (features[..., 0] * inside).sum(-1) / lengths
        return torch.logit(mean.clamp(0.001, 0.999))


def test_the_last_frame_of_a_chunk_is_scored_with_those_before_it():
    def scores(around):
        env = TransformedEnv(TabletopEnv(TASK, 1, image_size=32, seed=0, max_steps=8), Reflect(Average(), 0.999))
        env = around(env)
        actions = torch.zeros(1, 8, 7)
        actions[..., 1] = 1.0
        td = env.reset()
        if around is not chunked:
            for step in range(8):
                td = env.step(td.set(keys.ACTION, actions[:, step]))["next"]
            return td[keys.SUCCESS_PROB]
        return env.step(td.set(keys.CHUNK, actions))["next", keys.SUCCESS_PROB]

    assert torch.equal(scores(chunked), scores(lambda env: env))
