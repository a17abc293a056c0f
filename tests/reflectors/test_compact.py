"""Prefix sampling, batched prefix scores, and what the reward head learns."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.objectives import ReflectorLoss
from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig, prefix_indices


@pytest.fixture
def reflector():
    torch.manual_seed(0)
    return CompactReflector(CompactReflectorConfig(num_tasks=2, image_size=16, num_frames=6)).eval()


@pytest.mark.parametrize("length", [1, 2, 5, 6, 7, 31])
def test_a_prefix_is_sampled_evenly_with_its_first_and_last_frame(length):
    index = prefix_indices(torch.tensor([length]), 6)[0]
    used = min(length, 6)
    assert index[0] == 0
    assert index[used - 1] == length - 1
    gaps = index[:used].diff()
    assert not used > 1 or int(gaps.max() - gaps.min()) <= 1


def test_short_prefixes_beside_long_ones_show_all_their_frames_once():
    index = prefix_indices(torch.tensor([3, 20]), 6)
    assert index[0].tolist() == [0, 1, 2, 2, 2, 2]


def test_scores_of_a_chunks_prefixes_equal_those_of_each_prefix_alone(reflector):
    features = torch.randn(3, 14, reflector.feature_dim)
    first, task = torch.tensor([1, 4, 9]), torch.tensor([[0], [1], [0]])
    scores = reflector.prefix_scores(features, first, 5, task)
    for row in range(3):
        for k in range(5):
            length = int(first[row]) + k + 1
            index = prefix_indices(torch.tensor([length]), 6)[0]
            alone = reflector.score(features[row, index][None], torch.tensor([len(index)]), task[row : row + 1])
            torch.testing.assert_close(scores[row, k], alone[0])


def test_padding_frames_do_not_reach_the_score(reflector):
    features = torch.randn(1, 6, reflector.feature_dim)
    spoilt = features.clone()
    spoilt[:, 3:] = 1e3
    arguments = torch.tensor([3]), torch.tensor([[1]])
    torch.testing.assert_close(reflector.score(features, *arguments), reflector.score(spoilt, *arguments))


def test_a_reloaded_reflector_gives_the_same_scores(reflector, tmp_path):
    reflector.save_pretrained(tmp_path)
    again = CompactReflector.from_pretrained(tmp_path).eval()
    frames = torch.randint(256, (4, 3, 16, 16), dtype=torch.uint8)
    assert torch.equal(again.encode(frames), reflector.encode(frames))
    features = torch.randn(2, 4, reflector.feature_dim)
    arguments = features, torch.tensor([4, 2]), torch.tensor([[0], [1]])
    assert torch.equal(again.score(*arguments), reflector.score(*arguments))


def test_the_loss_is_the_binary_cross_entropy_of_the_scores_and_leaves_the_encoder_alone(reflector):
    batch = TensorDict(
        {
            "features": torch.randn(5, 6, reflector.feature_dim),
            "lengths": torch.tensor([[1], [2], [3], [5], [6]]),
            keys.TASK_ID: torch.tensor([[0], [1], [0], [1], [0]]),
            "label": torch.tensor([[True], [False], [True], [True], [False]]),
        },
        batch_size=[5],
    )
    value = ReflectorLoss(reflector)(batch)["loss_reflector"]
    p = reflector.score(batch["features"], batch["lengths"].squeeze(-1), batch[keys.TASK_ID])
    expected = -sum((q if y else 1 - q).log() for q, y in zip(p, batch["label"].squeeze(-1), strict=True)) / 5
    torch.testing.assert_close(value, expected)
    value.backward()
    assert all(parameter.grad is None for parameter in reflector.encoder.parameters())
    assert any(parameter.grad is not None for parameter in reflector.head_parameters())


def test_the_reward_head_learns_when_a_bright_patch_appears(reflector):
    torch.manual_seed(1)
    frames = torch.randint(0, 40, (32, 8, 3, 16, 16), dtype=torch.uint8)
    onset = torch.randint(1, 9, (32,))
    label = torch.arange(8) >= onset[:, None]
    frames[label] = frames[label].clone().index_fill(-1, torch.arange(4, 8), 250)
    task = torch.zeros(32, 1, dtype=torch.int64)
    features = reflector.encode(frames.flatten(0, 1)).unflatten(0, (32, 8))
    optimizer = torch.optim.Adam(reflector.head_parameters(), lr=3e-3)
    loss = ReflectorLoss(reflector)
    for _ in range(60):
        row, frame = torch.randint(24, (64,)), torch.randint(8, (64,))
        sampled, used = reflector.sample_prefixes(features, row, frame + 1)
        batch = {
            "features": sampled,
            "lengths": used[:, None],
            keys.TASK_ID: task[row],
            "label": label[row, frame][:, None],
        }
        optimizer.zero_grad()
        loss(TensorDict(batch, batch_size=[64]))["loss_reflector"].backward()
        optimizer.step()
    scores = reflector.prefix_scores(features[24:], torch.zeros(8, dtype=torch.int64), 8, task[24:])
    assert ((scores > 0.5) == label[24:]).float().mean() > 0.95


def test_frames_of_another_size_and_settings_out_of_range_are_refused(reflector):
    with pytest.raises(ValueError, match=r"\[n, 3, 16, 16\], got \[1, 3, 8, 8\]"):
        reflector.encode(torch.zeros(1, 3, 8, 8, dtype=torch.uint8))
    with pytest.raises(ValueError, match="threshold"):
        CompactReflectorConfig(num_tasks=1, threshold=1.5)
    with pytest.raises(ValueError, match="num_frames must be at least 2"):
        CompactReflectorConfig(num_tasks=1, num_frames=1)
