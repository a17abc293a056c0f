"""Checkpoints on the Hub, without one: its functions are replaced at their boundary, or told to stay offline."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import pytest
import torch
from huggingface_hub.errors import RepositoryNotFoundError
from torch import nn

from worldenv_trl.hub import is_repo_id
from worldenv_trl.pretrained import CONFIG_NAME, WEIGHTS_NAME, Pretrained


@dataclass(frozen=True)
class TinyConfig:
    dim: int = 3


class Tiny(nn.Module, Pretrained):
    config_class = TinyConfig

    def __init__(self, config: TinyConfig):
        super().__init__()
        self.config = config
        self.weight = nn.Parameter(torch.arange(float(config.dim)))


@pytest.fixture
def no_hub(monkeypatch, tmp_path):
    """A working folder, and a Hub that must not be asked."""
    monkeypatch.chdir(tmp_path)
    for name in ("snapshot_download", "HfApi"):
        monkeypatch.setattr(huggingface_hub, name, lambda *_, **__: pytest.fail("the Hub was asked"))


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """A Hub of folders, and what was asked of it."""
    monkeypatch.chdir(tmp_path)
    calls: list[tuple] = []

    def snapshot_download(repo_id, *, revision=None, allow_patterns=None):
        calls.append(("download", repo_id, revision, allow_patterns))
        folder = tmp_path / "hub" / repo_id
        if not folder.is_dir():
            answer = SimpleNamespace(headers={}, request=None)
            raise RepositoryNotFoundError(f"404 Client Error.\n\nNot Found for url: .../{repo_id}.", response=answer)
        return str(folder)

    class Api:
        def create_repo(self, repo_id, *, private, exist_ok):
            calls.append(("create", repo_id, private, exist_ok))

        def create_branch(self, repo_id, *, branch, exist_ok):
            calls.append(("branch", repo_id, branch, exist_ok))

        def upload_folder(self, *, repo_id, folder_path, commit_message, revision):
            calls.append(("upload", repo_id, commit_message, revision))
            target = tmp_path / "hub" / repo_id
            target.mkdir(parents=True)
            for path in Path(folder_path).iterdir():
                (target / path.name).write_bytes(path.read_bytes())
            return SimpleNamespace(commit_url=f"https://hub/{repo_id}/commit/1")

    # As calls of the real ones would refuse arguments that they do not have.
    for real, fake in ((huggingface_hub.snapshot_download, snapshot_download), *_methods(Api)):
        assert set(_keywords(fake)) <= set(_keywords(real))
    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    monkeypatch.setattr(huggingface_hub, "HfApi", Api)
    return calls


def _methods(fake):
    names = ("create_repo", "create_branch", "upload_folder")
    return [(getattr(huggingface_hub.HfApi, name), getattr(fake, name)) for name in names]


def _keywords(function) -> list[str]:
    import inspect

    return list(inspect.signature(function).parameters)


def test_what_was_pushed_is_loaded_by_its_id(hub):
    model = Tiny(TinyConfig(dim=4))
    model.weight.data.add_(0.5)
    assert model.push_to_hub("someone/arm", private=True, revision="v1") == "https://hub/someone/arm/commit/1"
    loaded = Tiny.from_pretrained("someone/arm", revision="v1")
    assert loaded.config == model.config and torch.equal(loaded.weight, model.weight)
    assert hub == [
        ("create", "someone/arm", True, True),
        ("branch", "someone/arm", "v1", True),
        ("upload", "someone/arm", "Upload a Tiny of worldenv_trl", "v1"),
        ("download", "someone/arm", "v1", [CONFIG_NAME, WEIGHTS_NAME]),  # nothing else of it, no pickle
    ]


def test_a_local_folder_of_the_same_name_wins(no_hub):
    Tiny(TinyConfig(dim=5)).save_pretrained("someone/arm")
    assert Tiny.from_pretrained("someone/arm").config.dim == 5


@pytest.mark.parametrize(
    "name",
    ["runs/arm/checkpoints/sft", "./arm", "../some/arm", "~/arm", "/some/arm", "arm", "here/arm", Path("someone/arm")],
)
def test_a_path_that_does_not_exist_is_said_to_be_missing_and_the_hub_is_not_asked(name, no_hub):
    Path("here").mkdir()
    assert not is_repo_id(name)
    with pytest.raises(FileNotFoundError, match=f"no Tiny checkpoint at .*{Path(name).name} is missing"):
        Tiny.from_pretrained(name)


def test_an_id_that_the_hub_does_not_have_is_one_line_with_the_remedy(hub):
    with pytest.raises(FileNotFoundError) as caught:
        Tiny.from_pretrained("someone/arm")
    said = str(caught.value)
    assert "\n" not in said and said.startswith("there is no folder someone/arm, and the Hugging Face Hub gave no")
    assert "404 Client Error" in said and "name a local folder" in said and "HF_HUB_OFFLINE=1" in said


def test_a_repository_of_something_else_is_named(hub, tmp_path):
    (tmp_path / "hub" / "someone" / "gpt").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=r"no Tiny checkpoint at someone/gpt: config.json is missing"):
        Tiny.from_pretrained("someone/gpt")


def test_a_name_that_is_no_id_and_a_hub_that_refuses_are_one_line(hub, monkeypatch):
    with pytest.raises(ValueError, match="is named owner/name, got 'arm'"):
        Tiny(TinyConfig()).push_to_hub("arm")
    assert not hub
    refused = OSError("401 Client Error: Unauthorized.\nInvalid username or password.")
    monkeypatch.setattr(huggingface_hub.HfApi, "create_repo", lambda *_, **__: (_ for _ in ()).throw(refused))
    with pytest.raises(OSError, match=r"^nothing was uploaded to someone/arm \(401 .*Unauthorized\): check .*login`$"):
        Tiny(TinyConfig()).push_to_hub("someone/arm")


def test_without_a_network_the_cached_copy_is_found_and_others_get_one_line(tmp_path):
    """The real functions of huggingface_hub, offline, on a cache in its own layout."""
    commit = hashlib.sha1(b"a commit").hexdigest()
    cache = tmp_path / "home" / "hub" / "models--someone--arm"
    Tiny(TinyConfig(dim=6)).save_pretrained(cache / "snapshots" / commit)
    (cache / "refs").mkdir()
    (cache / "refs" / "main").write_text(commit)
    code = (
        "from test_hub import Tiny\n"
        "print(Tiny.from_pretrained('someone/arm').config.dim)\n"
        "try: Tiny.from_pretrained('someone/else')\n"
        "except FileNotFoundError as error: print(error)\n"
    )
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    folder = Path(__file__).parent
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), str(folder.parent)])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    found, refused = done.stdout.splitlines()
    assert found == "6" and refused.startswith("there is no folder someone/else") and "HF_HUB_OFFLINE=1" in refused
