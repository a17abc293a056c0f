"""The rows of reflector and world model: at full size on the meta device, and tiny ones by the clock."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

sys.path.append(str(Path(__file__).parents[1] / "world_models"))

from small_diffusion import SMALL
from test_benchmarks import benchmark

import real_size_models
from real_size_row import costs

real_size = benchmark("real_size")

VISION = {
    "model_type": "siglip_vision_model", "hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1,
    "num_attention_heads": 2, "image_size": 28, "patch_size": 14, "vision_use_head": False,
}  # fmt: skip
TEXT = {
    "hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2,
    "num_key_value_heads": 1,
}  # fmt: skip


@pytest.fixture
def tiny_rows(monkeypatch):
    config = real_size_models.llava_onevision
    monkeypatch.setattr(
        real_size_models,
        "llava_onevision",
        lambda **text: type(config())(text_config=config(**text).text_config, vision_config=VISION),
    )
    monkeypatch.setattr(real_size_models, "IMAGE_SIZE", 32)
    small = {key: value for key, value in SMALL.items() if key != "image_size"}
    return [
        real_size_models.reflector_row("tiny-reflector", **TEXT),
        real_size_models.world_model_row("tiny-world-model", (2,), **small),
    ]


def test_tiny_rows_are_measured_on_a_device(capsys, monkeypatch, tiny_rows):
    monkeypatch.setattr(real_size, "chosen", lambda names: tiny_rows)
    monkeypatch.setattr(real_size, "matmul_bound", lambda *_: type("Speed", (), {"wall": 1e9}))
    real_size.main(real_size.Benchmark(device="cpu"))
    printed = capsys.readouterr().out
    assert "FAILED" not in printed
    for measured in ("score, batch 8", "imagined frame, batch 2", "training step, batch 4", "training step, batch 8"):
        assert f"measured {measured}, eager" in printed


def test_a_score_costs_what_arithmetic_says(tiny_rows):
    counted = costs(tiny_rows[0])
    reflector = tiny_rows[0].make()
    before, after = reflector.vlm.prompt_ids(reflector.config.text(real_size_models.INSTRUCTION))
    length, width = len(before) + len(after) + 32 * reflector.vlm.tokens_per_frame + 1, 16
    # A layer: queries and outputs of 16, keys and values of 8, three matrices to 32; and attention, twice the square.
    layer = 2 * length * (2 * width * 16 + 2 * width * 8 + 3 * width * 32) + 2 * 2 * length * length * 16
    language = 2 * layer
    assert counted.calls[0].flops == pytest.approx(language, rel=0.15)  # the rest is one frame's vision, and the head
    assert counted.calls[0].flops > language
    assert counted.calls[1].flops == pytest.approx(8 * counted.calls[0].flops, rel=0.01)
    assert counted.trainable == sum(parameter.numel() for parameter in reflector.head.parameters())


def test_the_full_world_model_is_counted_without_memory():
    (row,) = (row for row in real_size_models.ROWS if row.name == "world-model-evac-4-steps")
    with torch.device("meta"):
        model = row.make()
    assert model.unet.net.config.in_channels == 19 and model.unet.net.device.type == "meta"
    assert 1.4e9 < sum(parameter.numel() for parameter in model.unet.parameters()) < 1.7e9
