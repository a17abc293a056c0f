"""Counts of parts on the meta device against arithmetic."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from part_costs import counted, size
from peak_memory import PeakMemory, fused_attention

WIDTH, DEPTH, ROWS = 32, 3, 4


def stack(device: str = "meta") -> nn.ModuleDict:
    """Linear layers in a list, and a wider one beside them."""
    layers = nn.ModuleList(nn.Linear(WIDTH, WIDTH, bias=False) for _ in range(DEPTH))
    return nn.ModuleDict({"layers": layers, "head": nn.Linear(WIDTH, 4 * WIDTH, bias=False)}).to(device)


def through(module: nn.ModuleDict, device: str = "meta") -> torch.Tensor:
    hidden = torch.zeros(ROWS, WIDTH, device=device)
    for layer in module["layers"]:
        hidden = layer(hidden)
    return module["head"](hidden)


def test_sizes_are_those_of_arithmetic():
    module = stack()
    module["layers"].requires_grad_(False)
    found, layer = size(module), WIDTH * WIDTH
    assert (found.parameters, found.weight_bytes) == ((DEPTH + 4) * layer, 4 * (DEPTH + 4) * layer)
    assert (found.trainable, found.gradient_bytes, found.optimizer_bytes) == (4 * layer, 16 * layer, 32 * layer)
    assert found.layer_bytes == 16 * layer  # the head's; the list's layers are smaller, one by one
    assert size(module, []).optimizer_bytes == 0


@pytest.mark.parametrize("device", ["meta", "cpu"])
def test_operations_and_reads_are_those_of_arithmetic(device):
    module, layer = stack(device), WIDTH * WIDTH
    call = counted(module, ROWS, lambda: through(module, device))
    assert call.flops == 2 * (DEPTH + 4) * layer
    assert call.read_bytes == 4 * (DEPTH + 4) * layer
    # The last hidden state and what the head makes of it; a layer's input is gone by then.
    assert call.activation_bytes == 4 * (WIDTH + 4 * WIDTH)


def test_training_counts_both_passes_and_no_gradients():
    module, layer = stack(), WIDTH * WIDTH
    module["layers"].requires_grad_(False)
    call = counted(module, ROWS, lambda: through(module).sum().backward(), training=True)
    assert call.flops == 2 * (DEPTH + 4 + 4) * layer  # the head's weights have gradients, its input needs none
    assert all(each.grad is None for each in module.parameters())
    # Beside the activations of a row there is at most one gradient at a time, never all of them.
    assert call.activation_bytes * ROWS < 16 * layer + 3 * 4 * ROWS * 4 * WIDTH


@pytest.mark.parametrize("masked", [False, True])
def test_attention_on_the_meta_device_holds_no_matrix_of_all_with_all(masked):
    length, shape = 512, (2, 4, 512, 8)
    mask = torch.zeros(2, 1, length, length, device="meta") if masked else None

    def attend() -> torch.Tensor:
        query = torch.zeros(shape, device="meta")
        key = torch.zeros(2, 2, length, 8, device="meta")
        return F.scaled_dot_product_attention(query, key, key, mask, enable_gqa=True)

    with PeakMemory() as plain:
        out = attend()
    with fused_attention(), PeakMemory() as fused:
        assert attend().shape == out.shape
    matrix = 2 * 4 * length * length * 4
    assert plain.peak > matrix > 8 * fused.peak
    before = F.scaled_dot_product_attention
    with pytest.raises(ZeroDivisionError), fused_attention():
        raise ZeroDivisionError
    assert F.scaled_dot_product_attention is before


def test_attention_elsewhere_is_what_it_is():
    query, key, value = torch.randn(3, 2, 4, 16, 8)
    with fused_attention():
        inside = F.scaled_dot_product_attention(query, key, value)
    assert torch.equal(inside, F.scaled_dot_product_attention(query, key, value))
