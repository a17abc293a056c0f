"""LPIPS against its formula written out, on random weights in the published layout."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from worldenv_trl.metrics import LPIPS

ALEX = [("conv", 0, 4, 2), ("relu",), ("pool",), ("conv", 3, 1, 2), ("relu",), ("pool",), ("conv", 6, 1, 1), ("relu",),
        ("conv", 8, 1, 1), ("relu",), ("conv", 10, 1, 1), ("relu",)]  # fmt: skip
ALEX_SHAPES = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
VGG_WIDTHS = {0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256),
              17: (512, 256), 19: (512, 512), 21: (512, 512), 24: (512, 512),
              26: (512, 512), 28: (512, 512)}  # fmt: skip


def published(shapes, widths) -> tuple[dict, dict]:
    """State dicts as torchvision's and richzhang's are: the classifier's other layers stand beside the features."""
    torch.manual_seed(0)
    features = {"classifier.1.weight": torch.zeros(4, 4)}
    for place, shape in shapes.items():
        features[f"features.{place}.weight"] = torch.randn(shape) * (2 / (shape[1] * shape[2] ** 2)) ** 0.5
        features[f"features.{place}.bias"] = 0.1 * torch.randn(shape[0])
    heads = {f"lin{place}.model.1.weight": torch.rand(1, width, 1, 1) for place, width in enumerate(widths)}
    return features, heads


@pytest.fixture
def alex(tmp_path):
    features, heads = published(ALEX_SHAPES, (64, 192, 384, 256, 256))
    save_file(features, tmp_path / "alexnet.safetensors")
    save_file(heads, tmp_path / "alex.safetensors")
    return tmp_path, features, heads


def written_out(one, other, features, heads):
    """The formula for two images [3, H, W] of 0 to 255, with loops over layers and no module."""
    stages = []
    for image in (one, other):
        hidden = image.double() / 255 * 2 - 1
        mean, deviation = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
        hidden = torch.stack([(hidden[c] - mean[c]) / deviation[c] for c in range(3)])[None]
        found = []
        for kind, *about in ALEX:
            if kind == "conv":
                place, stride, padding = about
                weight, bias = (features[f"features.{place}.{name}"].double() for name in ("weight", "bias"))
                hidden = F.conv2d(hidden, weight, bias, stride, padding)
            elif kind == "pool":
                hidden = F.max_pool2d(hidden, 3, 2)
            else:
                hidden = hidden.clamp(min=0)
                found.append(hidden / (hidden.norm(dim=1, keepdim=True) + 1e-10))
        stages.append(found)
    total = 0.0
    for place, (left, right) in enumerate(zip(*stages, strict=True)):
        weight = heads[f"lin{place}.model.1.weight"].double()
        total += F.conv2d((left - right) ** 2, weight).mean().item()
    return total


def test_it_is_its_formula(alex):
    folder, features, heads = alex
    images = torch.randint(0, 256, (2, 3, 3, 48, 64), dtype=torch.uint8)
    found = LPIPS.from_folder(folder)(images[0], images[1])
    assert found.shape == (3,)
    for row in range(3):
        expected = written_out(images[0, row], images[1, row], features, heads)
        assert found[row].item() == pytest.approx(expected, rel=1e-4) and expected > 0.01


def test_equal_images_are_at_no_distance_and_leading_dimensions_are_kept(alex):
    lpips = LPIPS.from_folder(alex[0])
    images = torch.randint(0, 256, (2, 3, 3, 32, 32), dtype=torch.uint8)
    assert lpips(images, images).tolist() == [[0.0] * 3] * 2
    blurred = F.avg_pool2d(images.flatten(0, 1).float(), 3, 1, 1).reshape(images.shape)
    assert bool((lpips(blurred, images) > 0).all())
    assert not any(parameter.requires_grad for parameter in lpips.parameters())


def test_vgg_is_recognised_by_its_layers(tmp_path):
    features, heads = published({place: (*pair, 3, 3) for place, pair in VGG_WIDTHS.items()}, (64, 128, 256, 512, 512))
    save_file(features | heads, tmp_path / "vgg.safetensors")
    lpips = LPIPS.from_folder(tmp_path)
    assert len(lpips.features) == 30 and [len(head) for head in lpips.heads] == [64, 128, 256, 512, 512]
    black = torch.zeros(1, 3, 32, 32)
    assert lpips(black, black + 200).item() > 0


def test_what_is_missing_is_said_with_where_to_get_it(alex, tmp_path):
    folder, features, heads = alex
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(FileNotFoundError, match=r"holds no weights for LPIPS.*alexnet-owt-7be5be79\.pth.*alex\.pth"):
        LPIPS.from_folder(empty)
    (empty / "alex.pth").write_bytes(b"")
    with pytest.raises(ValueError, match=r"pickles alone.*python -c .*alex\.safetensors"):
        LPIPS.from_folder(empty)
    save_file({name: value for name, value in heads.items() if "lin3" not in name}, folder / "alex.safetensors")
    with pytest.raises(ValueError, match=r"lacks lin3\.model\.1\.weight"):
        LPIPS.from_folder(folder)
    save_file(heads | {"lin0.model.1.weight": torch.rand(1, 128, 1, 1)}, folder / "alex.safetensors")
    with pytest.raises(ValueError, match=r"lin0\.model\.1\.weight must hold \[64\], got \[1, 128, 1, 1\]"):
        LPIPS.from_folder(folder)
    del features["features.10.weight"], features["features.10.bias"]
    save_file(features, folder / "alexnet.safetensors")
    with pytest.raises(ValueError, match="the features of neither AlexNet nor VGG16"):
        LPIPS.from_folder(folder)
    (folder / "alexnet.safetensors").write_bytes(b"cut")
    with pytest.raises(ValueError, match=r"alexnet\.safetensors is truncated"):
        LPIPS.from_folder(folder)
    with pytest.raises(ValueError, match="net must be one of alex, vgg, got 'squeeze'"):
        LPIPS("squeeze")


def test_images_that_cannot_be_compared_are_refused():
    lpips = LPIPS("alex")
    with pytest.raises(ValueError, match="same shape"):
        lpips(torch.zeros(1, 3, 32, 32), torch.zeros(1, 3, 32, 48))
    with pytest.raises(ValueError, match="at least 32 px"):
        lpips(torch.zeros(1, 3, 16, 32), torch.zeros(1, 3, 16, 32))
