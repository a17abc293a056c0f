"""The loss that trains any reflector by its own lessons."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl.objectives import ReflectorLoss
from worldenv_trl.reflectors import CompactLessons, CompactReflector, CompactReflectorConfig, Reflector


def make(smoothing=0.0):
    torch.manual_seed(0)
    config = CompactReflectorConfig(("open the drawer", "close it"), image_size=16, num_frames=6)
    return CompactReflector(config, CompactLessons(label_smoothing=smoothing)).eval()


def batch(reflector, **entries):
    words = reflector.vocabulary.ids(["open the drawer", "close it", "close it", "open the drawer", "close it"])
    label = torch.tensor([[True], [False], [True], [True], [False]])
    return TensorDict({"words": words, "label": label, **entries}, batch_size=[5])


def prefixes(reflector):
    torch.manual_seed(1)
    lengths = torch.tensor([[1], [2], [3], [5], [6]])
    return batch(reflector, features=torch.randn(5, 6, 96), lengths=lengths)


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_of_prefixes_it_is_the_cross_entropy_of_the_smoothed_labels_and_leaves_the_encoder_alone(smoothing):
    reflector = make(smoothing)
    data = prefixes(reflector)
    out = ReflectorLoss(reflector)(data)
    query = reflector.query(data["words"])
    p = reflector.logits(data["features"], data["lengths"].squeeze(-1), query).sigmoid()
    target = [1 - smoothing / 2 if yes else smoothing / 2 for yes in data["label"].squeeze(-1)]
    expected = -sum(y * q.log() + (1 - y) * (1 - q).log() for q, y in zip(p, target, strict=True)) / 5
    torch.testing.assert_close(out["loss_reflector"], expected)
    torch.testing.assert_close(out["accuracy"], ((p > 0.5) == data["label"].squeeze(-1)).float().mean())
    assert not out["accuracy"].requires_grad
    out["loss_reflector"].backward()
    assert all(parameter.grad is None for parameter in reflector.encoder_parameters())
    assert all(parameter.grad is not None for parameter in reflector.head_parameters())


def test_of_frames_it_trains_the_encoder_and_leaves_the_head_alone():
    reflector = make(smoothing=0.1)
    frames = {"frames": {"image": 255 * torch.rand(5, 3, 16, 16)}, "first": {"image": 255 * torch.rand(5, 3, 16, 16)}}
    out = ReflectorLoss(reflector)(batch(reflector, **frames))
    out["loss_reflector"].backward()
    assert all(parameter.grad is not None for parameter in reflector.encoder_parameters())
    assert all(parameter.grad is None for parameter in reflector.head_parameters())


def test_only_the_loss_is_summed_by_a_loop_that_sums_losses():
    class Chatty(CompactReflector):
        def training_loss(self, batch):
            return super().training_loss(batch).set("loss_of_something_else", torch.ones(()))

    reflector = Chatty(make().config)
    assert sorted(ReflectorLoss(reflector)(prefixes(reflector)).keys()) == ["accuracy", "loss_reflector"]


def test_a_reflector_without_lessons_says_so():
    class Untrained(Reflector):
        def begin(self, frames, instructions): ...
        def extend(self, state, frames): ...

    assert list(Untrained().train_on(None)) == []
    with pytest.raises(TypeError, match="Untrained is not trained"):
        ReflectorLoss(Untrained())(TensorDict(batch_size=[1]))
