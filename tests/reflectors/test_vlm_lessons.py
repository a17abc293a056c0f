"""The VLM reflector's head learns from cached embeddings; what it promises is then calibrated."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("transformers")
from tiny_vlm import save_tiny_vlm
from videos import patches, work_through

from worldenv_trl.data import score_episodes
from worldenv_trl.keys import TASK_ID
from worldenv_trl.reflectors import VLMLessons, VLMReflector, VLMReflectorConfig
from worldenv_trl.reflectors.vlm_lessons import balanced, chosen_prefixes

TASKS = ["push left before right", "push right before left"]


def make(tmp_path, **lessons) -> VLMReflector:
    torch.manual_seed(0)
    config = VLMReflectorConfig(str(save_tiny_vlm(tmp_path)), num_frames=4, hidden_dim=64)
    return VLMReflector(config, VLMLessons(**lessons))


def test_embeddings_are_those_of_the_prefixes_and_made_once(tmp_path, monkeypatch):
    reflector, episodes = make(tmp_path, prefixes_per_episode=3, holdout=0.0), patches(4, TASKS, frames=9)
    calls = []
    encode = reflector.vlm.encode
    monkeypatch.setattr(reflector.vlm, "encode", lambda frames: (calls.append(len(frames)), encode(frames))[1])
    lesson = next(reflector.train_on(episodes))
    assert calls == [9] * 4  # every frame of an episode, once
    lesson.sample(), lesson.sample()
    assert calls == [9] * 4
    reflector.eval()
    scores = score_episodes(reflector, episodes)
    known = scores[:, [0, 4, 8]].flatten()  # linspace(0, 8, 3)
    drawn = reflector.logits(lesson.sample()["embedding"]).sigmoid()
    assert (drawn.unsqueeze(-1) - known).abs().min(-1).values.max() < 1e-5


def test_prefixes_are_spread_over_each_episode():
    episodes = patches(2, TASKS, frames=9)
    row, frame = chosen_prefixes(episodes, 5)
    assert row.tolist() == [0] * 5 + [1] * 5 and frame.tolist() == [0, 2, 4, 6, 8] * 2
    assert chosen_prefixes(episodes, None)[1].tolist() == [*range(9)] * 2


def test_tasks_and_outcomes_are_drawn_equally_often():
    label = torch.tensor([True, False, False, False, True, True])
    task = torch.tensor([0, 0, 0, 0, 1, 1])
    weights = balanced(label, task)
    torch.testing.assert_close(weights, torch.tensor([1 / 2, 1 / 6, 1 / 6, 1 / 6, 1 / 2, 1 / 2]))


def test_the_head_learns_what_the_embeddings_separate(tmp_path):
    reflector = make(tmp_path, holdout=0.0, lr=1e-3)
    generator = torch.Generator().manual_seed(0)
    label = torch.arange(64) % 2 == 0
    direction = torch.randn(32, generator=generator)
    embedding = torch.randn(64, 32, generator=generator) + 1.5 * (label.float() * 2 - 1).unsqueeze(-1) * direction

    episodes = patches(4, TASKS, frames=16)
    episodes.entries["success"] = label.reshape(4, 16)
    torch.manual_seed(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("worldenv_trl.reflectors.vlm_lessons.embed", lambda *_: embedding)
        (lesson,) = reflector.train_on(episodes)
    assert lesson.steps == 50 * 64 // 8 and lesson.sample().shape == (8,)
    losses = work_through(reflector)(lesson)
    assert losses[0] > 0.5 and losses[-1] < 0.1
    assert ((reflector.logits(embedding) > 0) == label).all()


def test_calibration_lowers_the_loss_of_episodes_the_head_has_not_seen(tmp_path):
    reflector = make(tmp_path, holdout=0.25, epochs=30, lr=3e-3, calibration_steps=300)
    teach = work_through(reflector)
    torch.manual_seed(1)
    lessons = reflector.train_on(patches(24, TASKS, frames=9))
    head = next(lessons)
    assert teach(head)[-1] < 0.65
    frozen = [parameter.clone() for parameter in reflector.head.parameters()]
    calibration = next(lessons)
    assert calibration.name == "calibration" and calibration.sample().shape[0] == 6 * 9
    losses = teach(calibration)
    assert losses[-1] < losses[0] - 1e-3
    batch = calibration.sample()
    # Where the loss of log-odds s x + b is least in b, promises and outcomes have the same mean.
    promised = reflector.logits(batch["embedding"]).sigmoid().mean()
    assert promised.item() == pytest.approx(batch["label"].float().mean().item(), abs=0.02)
    assert all(torch.equal(old, new) for old, new in zip(frozen, reflector.head.parameters(), strict=True))
    assert list(lessons) == []


def test_nothing_is_calibrated_on_one_outcome_alone(tmp_path):
    episodes = patches(10, TASKS, frames=4)
    episodes.entries["success"][[0]] = False
    lessons = list(make(tmp_path, holdout=0.1).train_on(episodes))
    assert [lesson.name for lesson in lessons] == ["head"]


def test_episodes_without_labels_are_refused_at_once(tmp_path):
    episodes = patches(2, TASKS, frames=4)
    del episodes.entries["success"]
    with pytest.raises(ValueError, match="no success labels"):
        make(tmp_path).train_on(episodes)
    assert TASK_ID in episodes


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "epochs, batch_size and calibration_steps must be at least 1, got 0"),
        ({"lr": 0.0}, "lr must be above 0 and holdout in"),
        ({"holdout": 0.6}, r"holdout in \[0, 0.5\], got 0.0001 and 0.6"),
        ({"prefixes_per_episode": 1}, "prefixes_per_episode must be at least 2, got 1"),
    ],
)
def test_lessons_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        VLMLessons(**settings)
