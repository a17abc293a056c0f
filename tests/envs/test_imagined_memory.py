"""What ImaginedEnv keeps of its rollouts, and what each of them is a function of."""

from __future__ import annotations

import copy

import pytest
import torch
from imagined_worlds import FK, SIZE, TWO, C, CountingWorldModel, given, make_env, with_chunk
from swaps.copying_world_model import CopyingConfig, CopyingWorldModel

from worldenv_trl import keys
from worldenv_trl.keys import CHUNK, IMAGE, KINEMATIC_STATE, KINEMATIC_STATES, NOISE_SEED, STATE
from worldenv_trl.language import instructions_of
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig

FRAMES = keys.frames_key("agentview")


class RememberingWorldModel(CountingWorldModel):
    """Remembers the frames that it is told to."""

    def __init__(self, indices) -> None:
        super().__init__()
        self._indices = indices

    def memory_indices(self, now: torch.Tensor) -> torch.Tensor:
        return torch.stack([index(now) for index in self._indices], -1)


MEMORIES = {
    "the newest": [lambda now: now],
    "half way and the newest": [lambda now: now // 2, lambda now: now],
    "the first, three before and the newest": [lambda now: 0 * now, lambda now: (now - 3).clamp(min=0), lambda n: n],
    "the last five": [lambda now, back=back: (now - back).clamp(min=0) for back in (4, 3, 2, 1, 0)],
}


@pytest.mark.parametrize("indices", MEMORIES.values(), ids=MEMORIES.keys())
def test_the_world_model_is_shown_what_a_full_video_would_show(indices):
    env = make_env(max_steps=4 * C + 2, world_model=RememberingWorldModel(indices))
    td = env.reset()
    images = {camera: [td[keys.image_key(camera)][:, :, None]] for camera in TWO}
    poses = [FK.pose(td[KINEMATIC_STATE])[:, :, None]]
    for decision in range(5):
        td = env.step(with_chunk(td, seed=decision))["next"]
        asked, now = env.world_model.requests[-1], decision * C
        numbers = [int(index(torch.tensor([now]))) for index in indices]
        for camera, frames in images.items():
            video, entry = torch.cat(frames, 2).flatten(0, 1), keys.image_entry(camera)
            assert torch.equal(asked["memory", "frames", entry], video[:, numbers])
            assert torch.equal(asked["memory", "reference", entry], video[:, 0])
            frames.append(td[keys.frames_key(camera)])
        assert torch.allclose(asked["memory", "poses"], torch.cat(poses, 2).flatten(0, 1)[:, numbers], atol=1e-6)
        poses.append(FK.pose(td[KINEMATIC_STATES]))


def kept(env) -> int:
    """Frames of a rollout and camera in the env's buffers, besides the one that is seen now."""
    sizes = [buffer.shape for buffer in env.buffers() if buffer.dtype == torch.uint8 and buffer.ndim == 5]
    assert len(sizes) == len(env.cameras) and all(size[2:] == (3, SIZE, SIZE) for size in sizes)
    return sizes[0][1]


def test_frames_are_kept_only_if_the_world_model_will_ask_for_them():
    for indices, expected in (
        (MEMORIES["the newest"], {0, 4, 8, 12}),
        (MEMORIES["half way and the newest"], {0, 2, 4, 6, 8, 12}),
        (MEMORIES["the last five"], set(range(13))),
    ):
        env = make_env(max_steps=4 * C, world_model=RememberingWorldModel(indices))
        assert kept(env) == len(expected)


def test_everything_that_rows_are_looked_up_in_moves_with_the_env():
    env = copy.deepcopy(make_env()).to("meta")  # a copy: tests share their kinematics
    assert {env._slot.device.type, env._poses.device.type, env._kept("agentview").device.type} == {"meta"}


def test_the_compact_world_model_has_two_frames_of_each_decision_kept():
    camera = {"pull": {"position": (1.2, 0, 0.8), "rotation": torch.eye(3).tolist(), "fovy": 45.0, "name": "agentview"}}
    config = VideoWorldModelConfig(
        cameras={"agentview": camera}, image_size=32, patch=2, width=16, blocks=(1, 1), chunk_length=C, memory_stride=2
    )
    env = make_env(max_steps=4 * C, world_model=VideoWorldModel(config))
    assert env.get_buffer("_memory_agentview").shape[1] == 1 + 2 * 3  # the first, and 2, 4, 6, 8, 10, 12


def test_a_world_model_that_copies_the_last_frame_shows_the_context_to_the_end():
    world_model = CopyingWorldModel(CopyingConfig(cameras=TWO, image_size=SIZE, chunk_length=C))
    env = make_env(world_model=world_model)
    start = env.reset()
    td = start
    for decision in range(3):
        td = env.step(with_chunk(td.clone(), seed=decision))["next"]
        for camera in TWO:
            first = start[keys.image_key(camera)].unsqueeze(2)
            assert torch.equal(td[keys.frames_key(camera)], first.expand(-1, -1, C, -1, -1, -1))


def test_every_row_is_asked_for_with_its_own_goal():
    env = make_env()
    td = env.reset(given(env, [[0, 1, 2], [1, 1, 0]]), set_state=True)
    env.step(with_chunk(td).set("_step", torch.tensor([[True, True, False], [False, True, True]])))
    assert instructions_of(env.world_model.requests[-1]) == ["pull", "push", "push", "pull"]


# -------------------------------------------------------------------------------------------------------- noise


def test_a_row_does_not_depend_on_the_other_rows():
    together, alone = make_env(3, 2), make_env(1, 2)
    a = together.reset(given(together, [[0, 0], [4, 4], [2, 2]]), set_state=True)
    b = alone.reset(given(alone, [[4, 4]]), set_state=True)
    for decision in range(3):
        with_chunk(a, seed=decision)
        b.set(CHUNK, a[CHUNK][1:2].clone())
        a, b = together.step(a)["next"], alone.step(b)["next"]
        for key in (FRAMES, keys.frames_key("wrist"), NOISE_SEED, KINEMATIC_STATES, STATE, IMAGE):
            assert torch.equal(a[key][1:2], b[key]), key


def test_rollouts_of_a_group_have_different_noise_and_so_have_waves_of_one_context():
    env = make_env(1, 2, count=1)
    waves = [env.step(with_chunk(env.reset()))["next", FRAMES] for _ in range(2)]
    assert not torch.equal(waves[0][0, 0, :, 1], waves[0][0, 1, :, 1])
    assert not torch.equal(waves[0][0, 0, :, 1], waves[1][0, 0, :, 1])


def test_every_decision_has_its_own_noise():
    env = make_env()
    td, seeds = env.reset(), []
    for decision in range(3):
        td = env.step(with_chunk(td, seed=decision))["next"]
        seeds += td[NOISE_SEED].flatten().tolist()
    assert len(set(seeds)) == 3 * 6


def test_given_contexts_replay_with_the_same_noise():
    env = make_env(1, 2)
    start = given(env, [[3, 3]])
    first, second = (env.step(with_chunk(env.reset(start.clone(), set_state=True)))["next", FRAMES] for _ in range(2))
    assert torch.equal(first, second)
