from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.data import policy_samples, reflector_samples


def make_episodes(lengths: list[int]) -> TensorDict:
    """Episodes whose frames, states and actions say which episode and step they are of."""
    rows, steps = len(lengths), max(lengths)
    place = torch.arange(rows).view(-1, 1) * 20 + torch.arange(steps + 1)
    length = torch.tensor(lengths).unsqueeze(-1)
    return TensorDict(
        {
            "frames": place.to(torch.uint8).view(rows, steps + 1, 1, 1, 1).expand(-1, -1, 3, 8, 8),
            "states": place.float().unsqueeze(-1).expand(-1, -1, 7),
            "actions": place[:, :-1].float().unsqueeze(-1).expand(-1, -1, 7) / 100,
            "success": torch.arange(steps + 1) == length,
            "length": length,
            keys.TASK_ID: torch.arange(rows).unsqueeze(-1),
        },
        batch_size=[rows],
    )


def test_every_executed_step_is_a_sample():
    samples = policy_samples(make_episodes([3, 5]), chunk_length=4)
    assert samples.batch_size == (8,)
    wanted = [0, 1, 2, 20, 21, 22, 23, 24]
    assert samples[keys.STATE][:, 0].int().tolist() == wanted
    assert samples[keys.IMAGE][:, 0, 0, 0].int().tolist() == wanted
    assert samples[keys.TASK_ID].flatten().tolist() == [0] * 3 + [1] * 5


def test_a_chunk_continues_to_the_end_and_repeats_the_last_action():
    samples = policy_samples(make_episodes([3, 5]), chunk_length=4)
    actions = (samples[keys.CHUNK][..., 0] * 100).round().int()
    assert actions[0].tolist() == [0, 1, 2, 2]
    assert samples[keys.ACTION_IS_PAD][0].tolist() == [False, False, False, True]
    assert actions[3].tolist() == [20, 21, 22, 23]
    assert not samples[keys.ACTION_IS_PAD][3].any()
    assert actions[7].tolist() == [24] * 4
    assert samples[keys.ACTION_IS_PAD][7].tolist() == [False, True, True, True]


def test_impossible_samples_are_refused():
    with pytest.raises(ValueError, match="chunk_length must be at least 1, got 0"):
        policy_samples(make_episodes([3]), chunk_length=0)
    empty = make_episodes([3])
    empty["length"] = torch.zeros(1, 1, dtype=torch.int64)
    with pytest.raises(ValueError, match="no executed step"):
        policy_samples(empty)


def test_reflector_labels_follow_the_physics_unless_asked_to_stay():
    episodes = make_episodes([3, 5])
    episodes["success"][1] = torch.tensor([False, False, True, True, False, False])
    samples = reflector_samples(episodes)
    assert torch.equal(samples["label"], episodes["success"])
    assert samples["mask"].tolist() == [[True] * 4 + [False] * 2, [True] * 6]
    stays = reflector_samples(episodes, once_solved=True)
    assert stays["label"][1].tolist() == [False, False, True, True, True, True]
    assert samples["frames"].data_ptr() == episodes["frames"].data_ptr()


def test_unlabelled_episodes_are_refused_by_the_reflector():
    with pytest.raises(ValueError, match="no success labels"):
        reflector_samples(make_episodes([3]).exclude("success"))
