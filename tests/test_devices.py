"""Devices by name, and batches on their way."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl.devices import choose_device, device_of, to_device


def test_auto_is_the_cpu_where_there_is_no_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == torch.device("cpu")


def test_auto_is_the_current_gpu_where_there_is_one(monkeypatch):
    for name, value in (("is_available", True), ("device_count", 2), ("current_device", 1)):
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    assert [str(choose_device(name)) for name in ("auto", "cuda", "cuda:0", "cpu")] == [
        "cuda:1",
        "cuda:1",
        "cuda:0",
        "cpu",
    ]


@pytest.mark.parametrize("name", ["gpu", "", "cuda:", "cuda:-1", "cuda:x", "cpu:0", "CUDA", "mps"])
def test_other_names_are_refused(name):
    with pytest.raises(ValueError, match=f"device must be auto, cpu, cuda or cuda:N, got '{name}'"):
        choose_device(name)


def test_a_gpu_that_does_not_exist_is_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"device 'cuda' does not exist here, .*: use auto or cpu"):
        choose_device("cuda")
    for name, value in (("is_available", True), ("device_count", 2)):
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    with pytest.raises(ValueError, match="device 'cuda:2' does not exist, this machine has cuda:0 to cuda:1"):
        choose_device("cuda:2")


def test_a_run_on_a_device_that_does_not_exist_ends_with_one_line_before_anything_is_made(tiny):
    import dataclasses

    from stages import open_run

    with pytest.raises(SystemExit, match=r"^error: device 'cuda:77' does not exist"):
        open_run(dataclasses.replace(tiny, device="cuda:77"))
    assert not tiny.run_dir.exists()


def test_a_module_is_where_its_first_tensor_is():
    assert device_of(torch.nn.Linear(1, 1, device="meta")) == torch.device("meta")
    assert device_of(torch.nn.BatchNorm1d(1, affine=False, device="meta")) == torch.device("meta")
    assert device_of(torch.nn.ReLU(), "meta") == torch.device("meta")


def test_a_batch_that_is_there_is_not_copied():
    batch = TensorDict({"nested": {"value": torch.zeros(2)}}, [2])
    assert to_device(batch, torch.device("cpu")) is batch
    assert to_device(batch, torch.device("meta"))["nested", "value"].device.type == "meta"
