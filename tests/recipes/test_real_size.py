"""What full-size parts cost: counts on the meta device against arithmetic."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from test_benchmarks import benchmark
from torch import nn

from real_size_row import PeakMemory, Row, costs

real_size = benchmark("real_size")
WIDTH, DEPTH = 64, 3


def _train(module: nn.Module) -> list[nn.Parameter]:
    module.requires_grad_(False)
    module[-1].requires_grad_(True)
    return [module[-1].weight]


def stack(name: str = "stack", **changes) -> Row:
    """Linear layers, of which the last one learns."""
    settings = {
        "name": name,
        "unit": "decision",
        "make": lambda: nn.Sequential(
            *(nn.Linear(WIDTH, WIDTH, bias=False, dtype=torch.bfloat16) for _ in range(DEPTH))
        ),
        "inputs": lambda module, batch: torch.zeros(batch, WIDTH, dtype=torch.bfloat16, device=module[0].weight.device),
        "call": lambda module, batch: module(batch),
        "train": _train,
        "loss": lambda module, batch: module(batch).sum(),
    }
    return Row(**(settings | changes))


def test_costs_are_those_of_arithmetic():
    counted = costs(stack())
    layer = WIDTH * WIDTH
    assert counted.parameters == DEPTH * layer
    assert counted.weight_bytes == 2 * DEPTH * layer
    assert [work.batch for work in counted.calls] == [1, 8]
    assert [work.flops for work in counted.calls] == [2 * DEPTH * layer * batch for batch in (1, 8)]
    # Two neighbouring layers' outputs live at a time; the last one's input is gone when nothing is kept for gradients.
    assert [work.peak_bytes for work in counted.calls] == [2 * WIDTH * 2 * batch for batch in (1, 8)]
    assert (counted.trainable, counted.gradient_bytes, counted.optimizer_bytes) == (layer, 2 * layer, 4 * layer)
    assert counted.training.flops == 2 * 4 * layer * (DEPTH + 1)  # forward, and one weight's gradient
    assert counted.training_bytes == 2 * DEPTH * layer + 4 * layer + counted.training.peak_bytes
    assert counted.training.peak_bytes >= 2 * layer
    assert {work.read_bytes for work in (*counted.calls, counted.training)} == {2 * DEPTH * layer}


def test_only_what_a_step_reads_counts_for_its_bound():
    """A head that learns from cached embeddings never touches what they were made with."""
    counted = costs(stack(loss=lambda module, batch: module[-1](batch).sum()))
    assert counted.training.read_bytes == 2 * WIDTH * WIDTH
    assert counted.calls[0].read_bytes == counted.weight_bytes == 2 * DEPTH * WIDTH * WIDTH


def test_peak_memory_counts_what_lives_at_one_time_and_views_once():
    with PeakMemory() as memory:
        first = torch.zeros(100, device="meta")
        view = first.view(10, 10)
        second = view + 1  # 800 bytes together
        del first, view
        third = second + 1
        del second, third
        torch.zeros(150, device="meta")
    assert memory.peak == 800


def test_a_row_that_fails_is_named_and_the_others_are_counted(capsys, monkeypatch):
    def broken():
        raise RuntimeError("no such layer\nand more")

    monkeypatch.setattr(real_size, "chosen", lambda names: [stack("bad", make=broken), stack("good")])
    real_size.main(real_size.Benchmark())
    printed = capsys.readouterr().out
    assert "bad FAILED: RuntimeError: no such layer (" in printed
    assert "good: 0 M parameters" in printed


def test_rows_are_measured_on_a_device_against_their_counts(capsys, monkeypatch):
    monkeypatch.setattr(real_size, "chosen", lambda names: [stack()])
    monkeypatch.setattr(real_size, "matmul_bound", lambda *_: type("Speed", (), {"wall": 1e9}))
    real_size.main(real_size.Benchmark(device="cpu"))
    printed = capsys.readouterr().out
    assert "measured decision, batch 8, eager" in printed and "measured training step, batch 4, eager" in printed
    assert "FAILED" not in printed


def test_an_unknown_row_is_refused_with_those_there_are(monkeypatch):
    monkeypatch.setattr(real_size, "FAMILIES", {"policy": "stand_in"})
    monkeypatch.setattr(real_size.importlib, "import_module", lambda name: type("Module", (), {"ROWS": (stack(),)}))
    with pytest.raises(ValueError, match="no row begins with 'polcy'; there are stack"):
        real_size.chosen(("polcy",))
    assert [row.name for row in real_size.chosen(("sta",))] == ["stack"]


def test_a_bound_is_the_slower_of_arithmetic_and_memory():
    gpu = real_size.GPUS[0]
    assert gpu.bound(int(gpu.bf16_flops), 0) == 1.0
    assert gpu.bound(0, int(2 * gpu.bandwidth)) == 2.0


@pytest.mark.parametrize(
    ("name", "published", "without"),
    [
        # Of the model cards' safetensors; without the language-modelling head, unless it is the embeddings again.
        ("policy-smolvlm-500m", 507_482_304, 49280 * 960),
        ("policy-paligemma-3b", 2_923_466_480, 0),
    ],
)
def test_backbones_have_the_sizes_that_were_published(name, published, without):
    pytest.importorskip("transformers")
    (row,) = real_size.chosen((name,))
    with torch.device("meta"):
        policy = row.make()
    base = [p for label, p in policy.backbone.model.named_parameters() if "lora_" not in label]
    assert sum(parameter.numel() for parameter in base) == published - without


def test_tokens_one_after_the_other_read_the_language_model_again_for_each():
    pytest.importorskip("transformers")
    from policies.hf_token_policies import token_policy

    (row,) = real_size.chosen(("policy-openvla-7b-tokens",))
    make = lambda: token_policy(lora_rank=32, gradient_checkpointing=True)  # noqa: E731
    small = dataclasses.replace(row, make=make, call_batches=(2,))
    counted = costs(small)
    with torch.device("meta"):
        policy = make()
    layers = [*policy.backbone.language_model.layers.parameters(), policy.action_head.weight]
    again = (policy.chunk_length * 7 - 1) * sum(each.numel() * each.element_size() for each in layers)
    read = counted.calls[0].read_bytes - again
    assert 0.8 * counted.weight_bytes < read <= counted.weight_bytes
    assert counted.training.flops / 4 > 1.5 * counted.calls[0].flops / 2  # forward, again and backward, of a row
