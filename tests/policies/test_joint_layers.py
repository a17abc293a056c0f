"""Layers of two towers: alone they are transformers' own, together one attention over both."""

from __future__ import annotations

import pytest
import torch
from hf_models import TEXT

pytest.importorskip("transformers")

from transformers import GemmaConfig, GemmaModel, LlamaConfig, LlamaModel

from worldenv_trl.policies.joint_layers import AdaptiveNorm, JointLayer, rotate, sinusoids

MODELS = {"llama": (LlamaConfig, LlamaModel), "gemma": (GemmaConfig, GemmaModel)}


def layers(kind: str) -> tuple[torch.nn.Module, list[JointLayer]]:
    torch.manual_seed(0)
    config, model = MODELS[kind]
    made = model(config(**TEXT)).eval()
    return made, [JointLayer(layer) for layer in made.layers]


@pytest.mark.parametrize("kind", list(MODELS))
def test_under_a_causal_mask_they_are_transformers_own(kind):
    torch.manual_seed(1)
    embeds = torch.randn(2, 5, 32)
    model, joint = layers(kind)
    wanted = model(inputs_embeds=embeds, use_cache=False).last_hidden_state
    hidden, positions = embeds, torch.arange(5).expand(2, -1)
    for layer in joint:
        hidden, _, _ = layer(hidden, positions, torch.ones(2, 5, 5, dtype=torch.bool).tril())
    torch.testing.assert_close(model.norm(hidden), wanted, rtol=1e-4, atol=1e-4)


def test_a_past_gives_what_all_tokens_at_once_give():
    torch.manual_seed(1)
    hidden, positions = torch.randn(2, 6, 32), torch.arange(6).expand(2, -1)
    layer = layers("llama")[1][0]
    mask = torch.ones(2, 6, 6, dtype=torch.bool)
    mask[:, :4, 4:] = False  # the first four do not see the last two
    whole, _, _ = layer(hidden, positions, mask)
    first, keys, values = layer(hidden[:, :4], positions[:, :4], mask[:, :4, :4])
    last, _, _ = layer(hidden[:, 4:], positions[:, 4:], mask[:, 4:], (keys, values))
    torch.testing.assert_close(torch.cat([first, last], 1), whole)


def test_only_keys_and_values_are_those_of_the_whole_layer():
    hidden, positions, mask = torch.randn(2, 3, 32), torch.arange(3).expand(2, -1), torch.ones(2, 3, 3).bool()
    model, joint = layers("gemma")
    _, *wanted = joint[0](hidden, positions, mask)
    alone = JointLayer(model.layers[0], "keys")
    same, *found = alone(hidden, positions, mask)
    assert torch.equal(same, hidden) and all(map(torch.equal, found, wanted))
    assert {name.split(".")[-2] for name, _ in alone.named_parameters()} == {"input_layernorm", "k_proj", "v_proj"}


def test_what_is_masked_changes_nothing():
    torch.manual_seed(1)
    layer, hidden = layers("llama")[1][0], torch.randn(1, 3, 32)
    past = [torch.randn(1, 2, 4, 8) for _ in range(2)]
    mask = torch.ones(1, 3, 7, dtype=torch.bool)
    mask[:, :, 2] = False
    before, _, _ = layer(hidden, torch.arange(3)[None], mask, tuple(past))
    past = [each.clone().index_fill_(2, torch.tensor(2), 100.0) for each in past]
    after, _, _ = layer(hidden, torch.arange(3)[None], mask, tuple(past))
    torch.testing.assert_close(after, before)


def test_rotary_products_depend_on_the_distance_alone():
    torch.manual_seed(1)
    query, key = torch.randn(2, 1, 1, 1, 16)
    products = [
        (rotate(query, torch.tensor([[at]])) * rotate(key, torch.tensor([[at + 3]]))).sum() for at in (0, 5, 40)
    ]
    torch.testing.assert_close(products[1:], products[:1] * 2, rtol=1e-4, atol=1e-4)


def test_the_shortest_and_the_longest_wave_of_time_have_their_periods():
    device = torch.device("cpu")
    start, short, long = (sinusoids(time, 8, 0.01, 0.5, device) for time in (0.0, 0.01, 0.5))
    assert torch.equal(start, torch.tensor([[0.0] * 4 + [1.0] * 4]))
    torch.testing.assert_close(short[0, [0, 4]], start[0, [0, 4]], rtol=0, atol=1e-5)
    torch.testing.assert_close(long[0, [3, 7]], start[0, [3, 7]], rtol=0, atol=1e-5)
    assert (short[0, 1:4] - start[0, 1:4]).abs().min() > 0.05


def test_an_adaptive_norm_begins_as_a_plain_one_behind_a_gate_that_its_condition_opens():
    torch.manual_seed(1)
    norm, x, condition = AdaptiveNorm(16, 1e-6), torch.randn(2, 3, 16), torch.randn(2, 16)
    torch.nn.init.zeros_(norm.dense.bias)
    normed, gate = norm(x, condition)
    torch.testing.assert_close(normed, torch.nn.functional.rms_norm(x, (16,), eps=1e-6))
    assert not gate.any()
    torch.nn.init.normal_(norm.dense.weight)
    normed, gate = norm(x, condition)
    scale, shift, wanted = norm.dense(condition)[:, None].chunk(3, -1)
    torch.testing.assert_close(normed, torch.nn.functional.rms_norm(x, (16,), eps=1e-6) * (1 + scale) + shift)
    assert torch.equal(gate, wanted)
