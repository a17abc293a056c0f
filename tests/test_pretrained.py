from __future__ import annotations

import json
from dataclasses import dataclass

import pytest
import torch
from torch import nn

from worldenv_trl.pretrained import CONFIG_NAME, WEIGHTS_NAME, Pretrained


@dataclass(frozen=True)
class TinyConfig:
    sizes: tuple[int, ...] = (3, 5)
    name: str = "tiny"


class Tiny(nn.Module, Pretrained):
    config_class = TinyConfig

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.config = config
        self.linear = nn.Linear(*config.sizes)
        self.register_buffer("mean", torch.zeros(config.sizes[0]))


class Other(Tiny):
    pass


@pytest.fixture
def saved(tmp_path):
    torch.manual_seed(0)
    model = Tiny(TinyConfig(sizes=(3, 4)))
    model.mean.fill_(2.5)
    model.save_pretrained(tmp_path / "model")
    return model, tmp_path / "model"


def test_a_reloaded_module_has_the_same_config_weights_and_buffers(saved):
    model, folder = saved
    loaded = Tiny.from_pretrained(folder)
    assert loaded.config == model.config
    assert loaded.state_dict().keys() == model.state_dict().keys()
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, loaded.state_dict()[name])


def test_saving_leaves_only_the_two_files_and_replaces_an_older_checkpoint(saved):
    model, folder = saved
    model.mean.fill_(-1)
    model.save_pretrained(folder)
    assert sorted(path.name for path in folder.iterdir()) == [CONFIG_NAME, WEIGHTS_NAME]
    assert Tiny.from_pretrained(folder).mean.eq(-1).all()


def test_a_failed_save_leaves_the_older_checkpoint_as_it_was(saved, monkeypatch):
    model, folder = saved
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    model.mean.fill_(-1)
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError("no space left on device")))
    with pytest.raises(OSError, match="no space"):
        model.save_pretrained(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("missing", [CONFIG_NAME, WEIGHTS_NAME])
def test_a_missing_file_is_named(saved, missing):
    _, folder = saved
    (folder / missing).unlink()
    with pytest.raises(FileNotFoundError, match=missing):
        Tiny.from_pretrained(folder)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        Tiny.from_pretrained(tmp_path / "nowhere")


@pytest.mark.parametrize("name", [CONFIG_NAME, WEIGHTS_NAME])
def test_a_truncated_file_is_named(saved, name):
    _, folder = saved
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=name):
        Tiny.from_pretrained(folder)


def test_a_flipped_byte_in_the_weights_is_noticed(saved):
    _, folder = saved
    data = bytearray((folder / WEIGHTS_NAME).read_bytes())
    data[-1] ^= 1
    (folder / WEIGHTS_NAME).write_bytes(data)
    with pytest.raises(ValueError, match="corrupt"):
        Tiny.from_pretrained(folder)


def test_a_checkpoint_of_another_class_names_both(saved):
    _, folder = saved
    with pytest.raises(ValueError, match=r"holds Tiny, not Other"):
        Other.from_pretrained(folder)


def test_a_config_that_does_not_fit_the_weights_is_refused(saved):
    _, folder = saved
    config = json.loads((folder / CONFIG_NAME).read_text())
    config["config"]["sizes"] = [3, 9]
    (folder / CONFIG_NAME).write_text(json.dumps(config))
    with pytest.raises(ValueError, match="does not hold the weights"):
        Tiny.from_pretrained(folder)


def test_an_unknown_config_field_is_refused(saved):
    _, folder = saved
    config = json.loads((folder / CONFIG_NAME).read_text())
    config["config"]["colour"] = "red"
    (folder / CONFIG_NAME).write_text(json.dumps(config))
    with pytest.raises(ValueError, match="colour"):
        Tiny.from_pretrained(folder)


def test_a_file_in_place_of_the_folder_is_refused(saved, tmp_path):
    model, _ = saved
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="name a folder"):
        model.save_pretrained(tmp_path / "file")
