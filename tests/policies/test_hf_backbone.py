"""The sequence, its mask and its positions, against the models' own ways and a slow one."""

from __future__ import annotations

import math

import pytest
import torch
from hf_models import FAMILIES, IMAGE_ID, RESOLUTION, backbone, hf_policy
from observations import observed
from torch import Tensor

from worldenv_trl.keys import ACTION_DIM, STATE, image_key
from worldenv_trl.policies.hf_backbone import VisionLanguageBackbone, _qwen_patches

transformers = pytest.importorskip("transformers")
PROPRIO_ID = 30
PLACEHOLDERS = 2 * ACTION_DIM


def pixels(rows: int = 2, cameras: int = 2) -> Tensor:
    return torch.randn(rows, cameras, 3, RESOLUTION, RESOLUTION, generator=torch.Generator().manual_seed(3))


def texts() -> tuple[Tensor, Tensor]:
    """Ids of two texts, the second one shorter and padded."""
    return torch.tensor([[8, 9, 10, 11], [0, 0, 12, 13]]), torch.tensor([[True] * 4, [False, False, True, True]])


def hidden_states(network: VisionLanguageBackbone, *inputs) -> tuple[Tensor, dict]:
    """Of the whole sequence, and what the language model was called with."""
    kept = {}

    def keep(module, args, kwargs, output):
        kept.update(kwargs, out=output.last_hidden_state)

    hook = network.language_model.register_forward_hook(keep, with_kwargs=True)
    network(*inputs)
    hook.remove()
    return kept.pop("out"), kept


@pytest.mark.parametrize("family", [family for family in FAMILIES if family != "prismatic"])
@torch.no_grad()
def test_images_and_text_are_seen_as_the_model_itself_sees_them(family):
    """The model's own forward, on ids in its processor's order; a token's embedding stands in for proprioception."""
    network = hf_policy(family, attention="prefix", lora_rank=0).backbone.eval()
    model, seen, (ids, valid) = network.model, pixels(1), texts()
    embed = network.language_model.get_input_embeddings()
    proprio = embed(torch.tensor([PROPRIO_ID]))
    ours, _ = hidden_states(network, seen, proprio, ids[:1], valid[:1], PLACEHOLDERS)

    tokens = network.image_features(seen[0]).shape[1]
    around = {"idefics3": ([3, 4], [3]), "smolvlm": ([3, 4], [3]), "qwen2_vl": ([5], [6]), "qwen2_5_vl": ([5], [6])}
    before, after = around.get(family, ([], []))
    images = 2 * [*before, *tokens * [IMAGE_ID], *after]
    first = [] if family.startswith("qwen") else [1]
    front = [*images, PROPRIO_ID, *first] if family.startswith("paligemma") else [*first, *images, PROPRIO_ID]
    whole = torch.tensor([[*front, *ids[0].tolist()]])
    extra = {"pixel_values": seen[0]}
    if family in ("idefics3", "smolvlm"):
        extra = {"pixel_values": seen}
    elif family.startswith("paligemma"):
        extra["token_type_ids"] = torch.zeros_like(whole)  # all of it is prefix
    elif family.startswith("qwen"):
        patches, grid = _qwen_patches(seen[0], model.config.vision_config)
        extra = {"pixel_values": patches, "image_grid_thw": grid, "mm_token_type_ids": (whole == IMAGE_ID).int()}
    theirs = model(input_ids=whole, attention_mask=torch.ones_like(whole), **extra).last_hidden_state
    torch.testing.assert_close(ours[:, : whole.shape[1]], theirs, rtol=1e-4, atol=1e-5)


def slow_llama(model: torch.nn.Module, sequence: Tensor, allowed: list[list[int]]) -> Tensor:
    """Llama's layers on one row [S, dim], token by token: each attends to the tokens it is allowed to, and no other."""
    config = model.config
    heads, width = config.num_attention_heads, config.head_dim
    shared = heads // config.num_key_value_heads
    turns = 1 / config.rope_parameters["rope_theta"] ** (torch.arange(0, width, 2) / width)

    def rotate(vector: Tensor, position: int) -> Tensor:
        a, b = vector.chunk(2)
        angle = position * turns
        return torch.cat([a * angle.cos() - b * angle.sin(), b * angle.cos() + a * angle.sin()])

    def norm(module: torch.nn.Module, x: Tensor) -> Tensor:
        return module.weight * x * (x.pow(2).mean(-1, keepdim=True) + config.rms_norm_eps).rsqrt()

    x = sequence
    for layer in model.layers:
        inner, attention = norm(layer.input_layernorm, x), layer.self_attn
        q, k, v = (
            each(inner).unflatten(-1, (-1, width)) for each in (attention.q_proj, attention.k_proj, attention.v_proj)
        )
        rows = []
        for i, keys_seen in enumerate(allowed):
            mixed = []
            for head in range(heads):
                query = rotate(q[i, head], i)
                scores = [query @ rotate(k[j, head // shared], j) / math.sqrt(width) for j in keys_seen]
                weights = torch.stack(scores).softmax(0)
                mixed.append(sum(w * v[j, head // shared] for w, j in zip(weights, keys_seen, strict=True)))
            rows.append(attention.o_proj(torch.cat(mixed)))
        x = x + torch.stack(rows)
        inner = norm(layer.post_attention_layernorm, x)
        x = x + layer.mlp.down_proj(torch.nn.functional.silu(layer.mlp.gate_proj(inner)) * layer.mlp.up_proj(inner))
    return norm(model.norm, x)


@pytest.mark.parametrize("stop", [None, 1])
@pytest.mark.parametrize("shift", [0, 1])
@pytest.mark.parametrize("attention", ["prefix", "full"])
@torch.no_grad()
def test_the_mask_is_that_of_a_slow_forward_over_unpadded_rows(attention, shift, stop):
    model = hf_policy("llava", lora_rank=0).backbone.model
    network = VisionLanguageBackbone(model, first_id=1, attention=attention, stop_id=stop, readout_shift=shift).eval()
    seen, (ids, valid) = pixels(), texts()
    proprio = torch.randn(2, network.dim)
    out = network(seen, proprio, ids, valid, PLACEHOLDERS)
    embed = network.language_model.get_input_embeddings()
    for row in range(2):
        parts = [
            embed(torch.tensor([1])),
            *network.image_features(seen[row]),
            proprio[row : row + 1],
            embed(ids[row][valid[row]]),
            torch.zeros(PLACEHOLDERS, network.dim),
            *([] if stop is None else [embed(torch.tensor([stop]))]),
        ]
        sequence = torch.cat(parts)
        behind = PLACEHOLDERS + (stop is not None)
        begin = len(sequence) - behind - shift  # of the tokens that see all
        everything = list(range(len(sequence)))
        allowed = [
            everything if attention == "full" or i >= begin else everything[: i + 1] for i in range(len(sequence))
        ]
        expected = slow_llama(network.language_model, sequence, allowed)[begin : begin + PLACEHOLDERS]
        torch.testing.assert_close(out[row], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("family", FAMILIES)
@torch.no_grad()
def test_padding_and_company_change_nothing(family):
    network = hf_policy(family, attention="prefix").backbone
    seen, (ids, valid) = pixels(), texts()
    proprio = torch.randn(2, network.dim)
    together = network(seen, proprio, ids, valid, PLACEHOLDERS)
    alone = network(seen[1:], proprio[1:], ids[1:, 2:], valid[1:, 2:], PLACEHOLDERS)
    torch.testing.assert_close(together[1:], alone, rtol=1e-4, atol=1e-5)
    garbage = network(seen, proprio, torch.where(valid, ids, 17), valid, PLACEHOLDERS)
    assert torch.equal(garbage, together)


@pytest.mark.parametrize("attention", ["prefix", "full"])
@torch.no_grad()
def test_placeholders_are_seen_by_the_text_only_where_attention_is_full(attention):
    network = hf_policy("smolvlm", attention=attention, lora_rank=0).backbone
    seen, (ids, valid) = pixels(), texts()
    proprio = torch.randn(2, network.dim)
    few, _ = hidden_states(network, seen, proprio, ids, valid, ACTION_DIM)
    many, _ = hidden_states(network, seen, proprio, ids, valid, PLACEHOLDERS)
    ahead = few.shape[1] - ACTION_DIM
    assert torch.allclose(few[0, :ahead], many[0, :ahead], atol=1e-6) == (attention == "prefix")


def test_qwens_patches_are_those_of_its_image_processor():
    vision = backbone("qwen2_5_vl").vision_config
    processor = transformers.Qwen2VLImageProcessorPil(
        patch_size=7, merge_size=2, temporal_patch_size=2, min_pixels=28 * 28, max_pixels=28 * 28
    )
    images = torch.randint(0, 256, (2, 3, RESOLUTION, RESOLUTION), dtype=torch.uint8)
    theirs = processor([*images], return_tensors="pt", do_resize=False)
    mean, std = (torch.tensor(each)[:, None, None] for each in (processor.image_mean, processor.image_std))
    patches, grid = _qwen_patches((images / 255 - mean) / std, vision)
    torch.testing.assert_close(patches, theirs["pixel_values"], rtol=1e-4, atol=1e-5)
    assert torch.equal(grid, theirs["image_grid_thw"])


@torch.no_grad()
def test_a_blank_image_is_seen_like_any_other():
    network = hf_policy("smolvlm", lora_rank=0).backbone
    blank = network.image_features(torch.zeros(2, 3, RESOLUTION, RESOLUTION))
    assert blank.shape == network.image_features(pixels(1)[0]).shape
    assert torch.equal(blank[0], blank[1])


def test_each_camera_counts_and_their_order_does():
    policy = hf_policy("llava", cameras=("agentview", "wrist"))
    td = observed(("agentview", "wrist"))
    images = [td[image_key(camera)] for camera in policy.cameras]
    swapped = td.clone()
    for camera, image in zip(policy.cameras, images[::-1], strict=True):
        swapped[image_key(camera)] = image
    first, second = (policy(each)["vla_action", "loc"] for each in (td, swapped))
    assert not torch.allclose(first, second, atol=1e-4)
    moved = td.clone().set(STATE, td[STATE] + 0.3)
    assert not torch.allclose(policy(moved)["vla_action", "loc"], first, atol=1e-4)
