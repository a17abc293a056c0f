"""Reward and stop over ImaginedEnv, in waves of a collector, with and without the frames."""

from __future__ import annotations

import pytest
import torch
from films import FirstPixel
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import FramesAside, ImaginedEnv, Reflect, TabletopEnv
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.language import instructions_of
from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig, StopRule
from worldenv_trl.world_models.base import WorldModel, memory_key

TASKS = ["starter/open_the_top_drawer", "starter/turn_on_the_stove"]
CAMERAS = ("agentview", "wrist")
SIZE, C, STEPS = 16, 4, 10


class Film(WorldModel):
    """Plays ``scores[context]``: the first pixel's red is the score, its blue counts the frames, its green the film."""

    def __init__(self, scores: torch.Tensor) -> None:
        super().__init__(cameras=CAMERAS, image_size=SIZE, chunk_length=C)
        self.scores = scores

    def memory_indices(self, now: torch.Tensor) -> torch.Tensor:
        return now.unsqueeze(-1)

    def forward(self, tensordict):
        for camera in self.cameras:
            newest = tensordict[memory_key(camera)][:, 0, :, 0, 0].long()  # [n, 3]
            number = newest[:, 2:] + torch.arange(1, C + 1)
            frames = torch.zeros(len(newest), C, 3, SIZE, SIZE, dtype=torch.uint8)
            frames[:, :, 0, 0, 0] = self.scores[newest[:, 1:2], number.clamp(max=self.scores.shape[1] - 1)]
            frames[:, :, 1, 0, 0], frames[:, :, 2, 0, 0] = newest[:, 1:2].byte(), number.byte()
            tensordict[keys.frames_key(camera)] = frames
        return tensordict


@pytest.fixture(scope="module")
def contexts():
    physics = TabletopEnv(TASKS, 2, image_size=SIZE, cameras=CAMERAS, proprio="commanded", num_threads=1)
    td = physics.reset()
    physics.close()
    for camera in CAMERAS:
        td[keys.image_key(camera)] = torch.zeros_like(td[keys.image_key(camera)])
        td[keys.image_key(camera)][:, 1, 0, 0] = torch.arange(2, dtype=torch.uint8)
    return td


def imagined(contexts, reflector, rule=StopRule(), *behind):  # noqa: B008
    film = torch.tensor([[0, 10, 20, 30, 40, 50, 200, 250, 60, 70, 80], [0, *[10] * 10]], dtype=torch.uint8)
    env = ImaginedEnv(Film(film), ForwardKinematics(), contexts, [2, 3], max_steps=STEPS, seed=0)
    return TransformedEnv(env, Compose(Reflect(reflector, rule), *behind))


def wave_of(env):
    policy = lambda td: td.set(keys.CHUNK, torch.zeros(*env.batch_size, C, 7))  # noqa: E731
    wave = next(iter(GroupCollector(env, policy, groups_per_batch=2)))
    return wave[wave[keys.TASK_ID][:, 0, 0, 0].argsort()]


@pytest.mark.parametrize("behind", [(), (FramesAside(),)])
def test_a_wave_ends_each_row_at_the_frame_that_the_rule_says(contexts, behind):
    wave = wave_of(imagined(contexts, FirstPixel(cameras=("wrist",)), StopRule(0.5), *behind))
    executed = (wave["next", keys.STEP_MASK] & wave[keys.MASK].unsqueeze(-1)).sum((-2, -1))
    assert executed.tolist() == [[6] * 3, [10] * 3]
    torch.testing.assert_close(wave["returns"][:, :, 0], torch.tensor([[200 / 255] * 3, [10 / 255] * 3]))
    shown = wave["next"][keys.WRIST_IMAGE][0, :, 1, 2, 0, 0]
    assert shown.tolist() == [6] * 3  # the frame that ended it
    assert (keys.FRAMES in wave["next"].keys()) == (not behind)  # noqa: SIM118


@pytest.mark.parametrize("behind", [(), (FramesAside(),)])
def test_specs_hold_over_groups(contexts, behind):
    check_env_specs(imagined(contexts, FirstPixel(cameras=CAMERAS), StopRule(), *behind))


def test_goals_of_the_groups_reach_the_reflector(contexts):
    torch.manual_seed(0)
    reflector = CompactReflector(CompactReflectorConfig(tuple(instructions_of(contexts)), CAMERAS, SIZE))
    td = imagined(contexts, reflector, StopRule(0.999)).reset()
    goals = instructions_of(td)
    assert goals[0] == goals[1] == goals[2] != goals[3]
    frames = {camera: td[keys.image_key(camera)].flatten(0, 1) for camera in CAMERAS}
    torch.testing.assert_close(td[keys.SUCCESS_PROB].flatten(), reflector.begin(frames, goals)["score"])


def test_a_reflector_of_a_camera_that_is_not_imagined_is_refused(contexts):
    with pytest.raises(ValueError, match=r"camera 'birdview' .* shows image, wrist_image\)"):
        imagined(contexts, FirstPixel(cameras=("birdview",)))


class Shared(FirstPixel):
    """Leaves imagination to another one."""

    def for_world(self, world: str) -> FirstPixel:
        return FirstPixel(cameras=self.cameras) if world == "imagined" else self


def test_a_reflector_that_leaves_imagination_to_another_one_is_refused_there_alone(contexts):
    judge = Shared(cameras=CAMERAS[:1])
    with pytest.raises(ValueError, match="Shared leaves imagination to its FirstPixel: pass reflector"):
        imagined(contexts, judge)
    imagined(contexts, judge.for_world("imagined")).reset()
    TransformedEnv(TabletopEnv(TASKS[0], 1, image_size=SIZE), Reflect(judge)).reset()
