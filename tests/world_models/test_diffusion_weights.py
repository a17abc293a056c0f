"""Pretrained weights from a local folder of diffusers."""

from __future__ import annotations

import json

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")
from diffusers import AutoencoderKL, AutoencoderKLTemporalDecoder, UNetSpatioTemporalConditionModel
from small_diffusion import CLIP, SMALL, UNET, VAE, ask, make_diffusion
from small_models import PULL
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from worldenv_trl.world_models import DiffusionWorldModelConfig, load_diffusers

# Stable Video Diffusion's UNet sees noisy latents beside an image's.
FEWER = UNET | {
    "in_channels": 8,
    "out_channels": 4,
    "addition_time_embed_dim": 256,
    "projection_class_embeddings_input_dim": 768,
}


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    """A folder as Stable Video Diffusion's, and its parts."""
    folder = tmp_path_factory.mktemp("svd")
    torch.manual_seed(7)
    clip = CLIPVisionConfig(**{key: value for key, value in CLIP.items() if key != "model_type"})
    parts = {
        "vae": AutoencoderKL.from_config(VAE),
        "unet": UNetSpatioTemporalConditionModel.from_config(FEWER),
        "image_encoder": CLIPVisionModelWithProjection(clip),
    }
    for name, part in parts.items():
        part.eval().save_pretrained(folder / name)
    return folder, parts


@pytest.fixture
def model(pretrained):
    sizes = DiffusionWorldModelConfig.sizes_of(pretrained[0])
    return make_diffusion(**sizes)


def test_sizes_and_weights_come_from_the_folder(pretrained, model):
    folder, parts = pretrained
    assert load_diffusers(model, folder) == ["vae", "unet", "image_encoder"]
    images = torch.rand(1, 2, 3, 16, 24) * 2 - 1
    latents = parts["vae"].encode(images[0]).latent_dist.mode() * VAE["scaling_factor"]
    torch.testing.assert_close(model.encode(images)[0], latents)
    pixels = torch.rand(2, 3, 16, 16)
    theirs = parts["image_encoder"].vision_model(pixel_values=pixels).last_hidden_state
    torch.testing.assert_close(model.context.encoder(pixel_values=pixels).last_hidden_state, theirs)


def test_a_widened_unet_begins_as_the_pretrained_one(pretrained, model):
    folder, parts = pretrained
    load_diffusers(model, folder)
    sample, context, added = torch.randn(1, 8, 19, 8, 12), torch.randn(1, 1, 2, 16), torch.rand(1, 3)
    with torch.no_grad():
        ours = model.unet(sample, torch.full((1, 8), 30), context.expand(1, 8, 2, 16), added)
        theirs = parts["unet"](sample[:, :, :8], torch.tensor([30]), context[:, 0], added).sample
    torch.testing.assert_close(ours, theirs)
    model.predict_v(
        torch.randn(1, 4, 4, 8, 12), torch.tensor([30]), model.conditions(ask(model, 1), [PULL])
    ).square().sum().backward()
    assert model.unet.net.conv_in.weight.grad[:, 8:].abs().sum() > 0  # and learns what the other channels say


def test_what_a_folder_does_not_have_is_left_alone(pretrained, model, tmp_path):
    (tmp_path / "vae").symlink_to(pretrained[0] / "vae")
    before = model.unet.net.conv_in.weight.clone()
    assert load_diffusers(model, tmp_path) == ["vae"]
    assert torch.equal(model.unet.net.conv_in.weight, before)


def test_a_folder_with_nothing_is_refused(model, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no vae, unet or image_encoder in .*: name a folder in the layout"):
        load_diffusers(model, tmp_path)
    with pytest.raises(FileNotFoundError, match="no vae, unet or image_encoder"):
        DiffusionWorldModelConfig.sizes_of(tmp_path)


def test_other_sizes_are_refused_by_name(pretrained):
    model = make_diffusion(vae=VAE | {"block_out_channels": (8, 12)})
    with pytest.raises(ValueError, match=r"vae: .* is \[.*\], the model's is \[.*\]: build the model with"):
        load_diffusers(model, pretrained[0])


def test_damaged_and_pickled_weights_are_refused(pretrained, model, tmp_path):
    vae = tmp_path / "vae"
    vae.mkdir()
    (vae / "config.json").write_text((pretrained[0] / "vae" / "config.json").read_text())
    with pytest.raises(FileNotFoundError, match=r"no \*\.safetensors in .*vae: copy the weights there"):
        load_diffusers(model, tmp_path)
    (vae / "diffusion_pytorch_model.bin").touch()
    with pytest.raises(ValueError, match=r"as a pickle, diffusion_pytorch_model\.bin, which may run code"):
        load_diffusers(model, tmp_path)
    whole = (pretrained[0] / "vae" / "diffusion_pytorch_model.safetensors").read_bytes()
    (vae / "diffusion_pytorch_model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="is truncated or corrupt"):
        load_diffusers(model, tmp_path)


def test_another_kind_of_vae_is_refused_with_the_remedy(tmp_path):
    AutoencoderKLTemporalDecoder(block_out_channels=(32,), layers_per_block=1).save_pretrained(tmp_path / "vae")
    with pytest.raises(
        ValueError, match=r"describes a AutoencoderKLTemporalDecoder, needed is a AutoencoderKL; Stable"
    ):
        DiffusionWorldModelConfig.sizes_of(tmp_path)


def test_sizes_make_a_config_that_is_plain(pretrained):
    sizes = DiffusionWorldModelConfig.sizes_of(pretrained[0])
    assert set(sizes) == {"vae", "unet", "image_encoder"} and json.dumps(sizes)
    assert sizes["unet"]["block_out_channels"] == [32, 32] and SMALL["unet"]["block_out_channels"] == (32, 32)
