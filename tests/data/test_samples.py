from __future__ import annotations

import pytest
import torch
from small_rollouts import make_episodes

from worldenv_trl import keys
from worldenv_trl.data import policy_samples, with_images
from worldenv_trl.language import instructions_of


def test_every_executed_step_is_a_sample():
    samples = policy_samples(make_episodes([3, 5]), chunk_length=4)
    assert samples.batch_size == (8,)
    assert samples[keys.STATE][:, 0].int().tolist() == [0, 1, 2, 50, 51, 52, 53, 54]
    assert instructions_of(samples) == ["goal 0"] * 3 + ["goal 1"] * 5


def test_a_sample_shows_every_camera_before_the_action():
    samples = policy_samples(make_episodes([3, 5]), chunk_length=4)
    for key, more in ((keys.IMAGE, 0), (keys.WRIST_IMAGE, 7)):
        assert samples[key].shape == (8, 3, 8, 8) and samples[key].dtype == torch.uint8
        assert samples[key][:, 0, 0, 0].tolist() == [value + more for value in (0, 1, 2, 50, 51, 52, 53, 54)]


def test_samples_may_be_of_one_camera():
    samples = policy_samples(make_episodes([3, 5]).through(["wrist"]))
    assert set(samples["observation"].keys()) == {"wrist_image", "state"}


def test_a_chunk_continues_to_the_end_and_repeats_the_last_action():
    episodes = make_episodes([3, 5])
    samples = policy_samples(episodes, chunk_length=4)
    actions = episodes["actions"]
    wanted = {0: (0, [0, 1, 2, 2]), 3: (1, [0, 1, 2, 3]), 4: (1, [1, 2, 3, 4]), 7: (1, [4, 4, 4, 4])}
    for sample, (row, steps) in wanted.items():
        assert torch.equal(samples[keys.CHUNK][sample], actions[row, steps])


def test_steps_past_the_end_of_the_episode_are_marked():
    padded = policy_samples(make_episodes([3, 5]), chunk_length=4)[keys.ACTION_IS_PAD]
    assert padded[[0, 3, 4, 7]].tolist() == [
        [False, False, False, True],
        [False] * 4,
        [False] * 4,
        [False, True, True, True],
    ]


def test_impossible_samples_are_refused():
    with pytest.raises(ValueError, match="chunk_length must be at least 1, got 0"):
        policy_samples(make_episodes([3]), chunk_length=0)
    empty = make_episodes([3])
    empty["length"] = torch.zeros(1, 1, dtype=torch.int64)
    with pytest.raises(ValueError, match="no executed step"):
        policy_samples(empty)


def test_the_waypoint_is_where_the_gripper_is_next_told_otherwise():
    episodes = make_episodes([3, 6, 1])
    episodes["actions"][..., -1] = -1.0
    episodes["actions"][1, [2, 3, 5], -1] = 1.0  # closes at 2, opens at 4, closes at 5
    samples = policy_samples(episodes, chunk_length=2)
    at = [(0, 3)] * 3 + [(1, step) for step in (2, 2, 4, 4, 5, 6)] + [(2, 1)]
    expected = torch.stack([episodes["states"][row, step, :3] for row, step in at])
    assert torch.equal(samples[keys.WAYPOINT], expected)


def test_the_approach_is_shared_out_by_how_far_each_action_goes_over_the_table():
    episodes = make_episodes([6])
    episodes["actions"].zero_()
    episodes["actions"][..., -1] = -1.0
    episodes["actions"][0, 3:, -1] = 1.0  # closes at 3
    episodes["actions"][0, :3, :2] = torch.tensor([[0.3, 0.4], [0.0, 0.2], [0.0, 0.0]])
    approach = policy_samples(episodes, chunk_length=2)[keys.APPROACH]
    told = [0.55, 0.25, 0.05]  # lengths, and .05 for every step
    expected = [[told[0] / 0.85, told[1] / 0.85], [told[1] / 0.3, told[2] / 0.3], [1.0, 0.0]]
    put = [[1 / 3, 1 / 3], [1 / 2, 1 / 2], [1.0, 0.0]]  # from 3 on it holds something: the end is where that is put
    torch.testing.assert_close(approach, torch.tensor(expected + put))


def test_what_is_neither_to_be_taken_nor_held_has_no_approach():
    episodes = make_episodes([4, 4, 5])
    episodes["actions"][..., -1] = torch.tensor([1.0, -1.0, -1.0])[:, None]  # always closed, always open
    episodes["actions"][2, :2, -1] = 1.0  # closed from the start, as for a drawer's handle, and open from 2 on
    ahead = policy_samples(episodes, chunk_length=2)[keys.APPROACH].sum(1) > 0
    assert ahead.tolist() == [False] * 8 + [True, True, False, False, False]


def test_a_sample_says_how_many_steps_were_executed_before_it():
    samples = policy_samples(make_episodes([3, 5]), chunk_length=4)
    assert samples[keys.NUM_STEPS].tolist() == [[0], [1], [2], [0], [1], [2], [3], [4]]


def test_images_may_be_added_later():
    episodes = make_episodes([3, 5])
    without = policy_samples(episodes, chunk_length=4, images=False)
    assert without["episode"].tolist() == [0] * 3 + [1] * 5
    assert not {keys.IMAGE, keys.INSTRUCTION} & set(without.keys(True))
    rows = torch.tensor([6, 0, 2])
    later, whole = with_images(episodes, without[rows]), policy_samples(episodes, chunk_length=4)[rows]
    assert set(later.keys(True, True)) == set(whole.keys(True, True))
    assert torch.equal(later[keys.WRIST_IMAGE], whole[keys.WRIST_IMAGE])
    assert instructions_of(later) == instructions_of(whole)
    with pytest.raises(ValueError, match="no samples"):
        with_images(episodes, without[:0])
