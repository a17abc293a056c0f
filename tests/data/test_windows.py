from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.data import WindowSampler, predicted_poses, world_model_windows
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.robot import panda

CHUNK = 4


class FakeModel:
    """Remembers the first, the previous and the newest frame."""

    chunk_length = CHUNK
    config = SimpleNamespace(image_size=8)

    def memory_indices(self, t: torch.Tensor) -> torch.Tensor:
        return torch.stack([torch.zeros_like(t), (t - 1).clamp(min=0), t], -1)


def make_episodes(lengths: list[int]) -> TensorDict:
    rows, steps = len(lengths), max(lengths)
    length = torch.tensor(lengths).unsqueeze(-1)
    place = torch.minimum(torch.arange(steps + 1), length)
    value = (torch.arange(rows).view(-1, 1) * 50 + place).to(torch.uint8)
    home = ForwardKinematics().initial_state(torch.as_tensor(panda.HOME_Q, dtype=torch.float32).expand(rows, 7))
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(rows, steps, 7, generator=generator) * 2 - 1
    return TensorDict(
        {
            "frames": value.view(rows, steps + 1, 1, 1, 1).expand(-1, -1, 3, 8, 8).contiguous(),
            "kinematic_states": home.unsqueeze(1).expand(-1, steps + 1, -1),
            "actions": actions * (torch.arange(steps) < length).unsqueeze(-1),
            "length": length,
            keys.TASK_ID: torch.arange(rows).unsqueeze(-1),
        },
        batch_size=[rows],
    )


def test_poses_are_predicted_from_the_first_state_step_by_step():
    episodes, kinematics = make_episodes([6, 3]), ForwardKinematics()
    poses = predicted_poses(episodes, kinematics)
    assert poses.shape == (2, 7, 13)
    for row in range(2):
        state = episodes["kinematic_states"][row, :1]
        for step in range(7):
            assert torch.allclose(poses[row, step], kinematics.pose(state)[0], atol=1e-5)
            if step < 6:
                state = kinematics(state, episodes["actions"][row, step : step + 1])


def test_a_window_holds_the_memory_and_what_follows():
    episodes = make_episodes([12, 9])
    poses = torch.arange(2 * 13 * 13).float().view(2, 13, 13)
    td = world_model_windows(episodes, poses, FakeModel(), torch.tensor([1, 0]), torch.tensor([3, 0]), chunks=2)
    assert td["memory", "frames"][:, :, 0, 0, 0].tolist() == [[50, 52, 53], [0, 0, 0]]
    assert torch.equal(td["memory", "poses"][0], poses[1, [0, 2, 3]])
    assert td["memory", "reference"][:, 0, 0, 0].tolist() == [50, 0]
    assert td["target_frames"][:, :, 0, 0, 0].tolist() == [[54, 55, 56, 57, 58, 59, 59, 59], list(range(1, 9))]
    assert td["target_mask"].tolist() == [[True] * 6 + [False] * 2, [True] * 8]
    assert torch.equal(td["poses"][1], poses[0, 1:9])
    assert torch.equal(td["padded_actions"][0, :6, :7], episodes["actions"][1, 3:9])
    assert not td["padded_actions"][0, 6:].any() and not td["padded_actions"][..., 7:].any()
    assert td[keys.TASK_ID].tolist() == [[1], [0]]


def test_a_start_outside_its_episode_is_refused():
    episodes = make_episodes([12, 9])
    poses = torch.zeros(2, 13, 13)
    with pytest.raises(ValueError, match="frame 10 of episode 1, which has frames 0 to 9"):
        world_model_windows(episodes, poses, FakeModel(), torch.tensor([0, 1]), torch.tensor([10, 10]))


def test_the_sampler_draws_every_start_and_no_other():
    lengths = [12, 3, 0, 5]
    sampler = WindowSampler(make_episodes(lengths), ForwardKinematics(), FakeModel(), chunks=1, reset_share=0.0, seed=0)
    assert len(sampler) == 9 + 1 + 0 + 2  # a start leaves room for a chunk, short episodes have one
    newest = sampler.sample(2000)["memory", "frames"][:, -1, 0, 0, 0]
    assert set(newest.tolist()) == {*range(9), 50, 150, 151}
    counts = torch.bincount(newest.long())
    assert counts[counts > 0].min() > 2000 / 12 * 0.6


def test_the_sampler_starts_at_the_reset_more_often_when_asked():
    sampler = WindowSampler(make_episodes([40]), ForwardKinematics(), FakeModel(), reset_share=0.5, seed=0)
    at_reset = (sampler.sample(1000)["memory", "frames"][:, -1, 0, 0, 0] == 0).float().mean()
    assert 0.4 < at_reset < 0.62


def test_failures_get_their_share_of_every_task():
    episodes = make_episodes([12, 12, 8, 12, 10])
    episodes[keys.TASK_ID] = torch.tensor([[0], [0], [0], [0], [1]])
    success = torch.zeros(5, 13, dtype=torch.bool)
    success[:3, 5:] = True  # task 0: three successes and a failure; task 1 only fails
    episodes["success"] = success

    def shares(failure_share):
        sampler = WindowSampler(episodes, ForwardKinematics(), FakeModel(), failure_share=failure_share, seed=0)
        row = sampler.sample(6000)["memory", "reference"][:, 0, 0, 0].long() // 50  # frames count from 50 r
        return torch.bincount(row, minlength=5) / 6000

    starts = torch.tensor([9, 9, 5, 9, 7]) / 39
    assert torch.allclose(shares(None), starts, atol=0.03)
    wanted = torch.cat([0.4 * torch.tensor([9, 9, 5]) / 23, torch.tensor([0.6, 1.0])]) / 2
    assert torch.allclose(shares(0.6), wanted, atol=0.03)
    with pytest.raises(ValueError, match="failure_share must lie between 0 and 1, got 2"):
        shares(2)


def test_the_sampler_repeats_itself_for_a_seed():
    episodes = make_episodes([12, 9])
    first, second = (WindowSampler(episodes, ForwardKinematics(), FakeModel(), seed=4).sample(8) for _ in range(2))
    assert (first == second).all()


def test_episodes_of_another_size_are_refused():
    episodes = make_episodes([12])
    episodes["frames"] = torch.zeros(1, 13, 3, 16, 16, dtype=torch.uint8)
    with pytest.raises(ValueError, match="sees 8 px images"):
        WindowSampler(episodes, ForwardKinematics(), FakeModel())
    with pytest.raises(ValueError, match="no executed step"):
        WindowSampler(make_episodes([5])[:0], ForwardKinematics(), FakeModel())
