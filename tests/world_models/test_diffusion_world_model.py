"""The full-size world model on tiny networks: what it is told, what it paints, what it refuses."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")
from small_diffusion import CLIP, SMALL, UNET, VAE, ask, make_diffusion
from small_models import FRONT, ONE, PULL, PUSH, TWO

from worldenv_trl.keys import NOISE_SEED, frames_key
from worldenv_trl.kinematics import ActionMap
from worldenv_trl.robot import WRIST
from worldenv_trl.world_models import DiffusionWorldModel, DiffusionWorldModelConfig, memory_key


@pytest.fixture(scope="module")
def model():
    return make_diffusion(TWO)


def frames(model, td, **changes) -> torch.Tensor:
    painted = model(td.clone().update(changes))
    return torch.stack([painted[frames_key(camera)] for camera in model.cameras], 1)


def close(first: torch.Tensor, second: torch.Tensor) -> bool:
    """Equal up to one intensity level: the order of sums may depend on the batch."""
    return int((first.int() - second.int()).abs().max()) <= 1


def test_it_paints_every_camera_and_remembers_equal_parts(model):
    assert frames(model, ask(model, 2)).shape == (2, 2, 4, 3, 32, 32)
    assert model.memory_indices(torch.tensor([0, 4, 20])).tolist() == [[0] * 4, [0, 1, 2, 4], [0, 6, 13, 20]]


def test_a_row_depends_on_its_request_alone(model):
    asked = ask(model, 3)
    together = frames(model, asked)
    torch.manual_seed(5)
    for row in range(3):
        assert close(frames(model, asked[row : row + 1]), together[row : row + 1])
    model.config.__dict__["rows_per_call"] = 3
    assert close(frames(model, asked), together)
    model.config.__dict__["rows_per_call"] = None


def test_noise_is_that_of_the_seed(model):
    asked = ask(model, 1)
    assert torch.equal(frames(model, asked), frames(model, asked))
    assert not close(frames(model, asked, **{NOISE_SEED: torch.full((1, 1), 7)}), frames(model, asked))


@pytest.mark.parametrize("key", ["poses", "padded_actions", memory_key("agentview"), memory_key("wrist")])
def test_everything_in_the_request_counts(model, key):
    asked = ask(model, 1)
    changed = asked.clone()
    changed[key] = asked[key].roll(1, -1) if key != "poses" else asked[key] + torch.tensor([0.1, 0.1, *[0.0] * 11])
    conditions, other = (model.conditions(td, [PULL]) for td in (asked, changed))
    x, times = torch.randn(1, 4, 4, 16, 12), torch.tensor([500])
    assert (model.predict_v(x, times, conditions) - model.predict_v(x, times, other)).abs().max() > 1e-4


def test_the_network_sees_evacs_channels_in_order(model):
    asked = ask(model, 1)
    known = model.conditions(asked, [PULL])
    assert known.memory.shape == (1, 4, 4, 16, 12)  # two views of 8 x 12 cells, one below the other
    image, mask, maps, rays = known.fixed.split([4, 1, 4, 6], 2)
    newest = torch.cat([model.encode(asked[memory_key(c)][:, -1:].float() * (2 / 255) - 1) for c in model.cameras], -2)
    torch.testing.assert_close(image, newest.expand(-1, 8, -1, -1, -1))
    torch.testing.assert_close(known.memory[:, -1], newest[:, 0])
    assert mask[0, :, 0, 0, 0].tolist() == [1] * 4 + [0] * 4
    assert maps.std() > 0 and known.context.shape == (1, 8, 4, 16)
    origin, direction = rays[0, :, :3, :8], rays[0, :, 3:, :8]  # the first camera's
    torch.testing.assert_close(origin, torch.tensor(FRONT.position).view(1, 3, 1, 1).expand_as(origin))
    torch.testing.assert_close(direction.norm(dim=1), torch.ones(8, 8, 12))


def test_a_point_on_a_cells_ray_is_seen_in_that_cell():
    action_map, poses = ActionMap([FRONT, WRIST], 32), torch.zeros(2, 13)
    poses[:, 3:12] = torch.eye(3).flatten()
    poses[1, :3] = torch.tensor([0.1, -0.2, 0.3])
    poses[1, 3:12] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).flatten()
    for camera in (0, 1):
        index = torch.full((2,), camera)
        rays = action_map.rays(poses, (4, 8), index)
        points = rays[:, :3] + 0.7 * rays[:, 3:]  # [2, 3, 4, 8]
        pixels = action_map.project(points.flatten(2).mT, index.unsqueeze(-1), poses.unsqueeze(1))
        down, across = torch.meshgrid(torch.arange(4) * 8 + 4.0, torch.arange(8) * 4 + 2.0, indexing="ij")
        expected = torch.stack([across, down], -1).flatten(0, 1).expand(2, -1, -1)
        torch.testing.assert_close(pixels, expected, atol=1e-3, rtol=0)


def test_remembered_frames_are_told_time_zero_and_painted_ones_the_samplers(model, monkeypatch):
    told = []
    unet = type(model.unet)
    forward = unet.forward
    monkeypatch.setattr(
        unet, "forward", lambda self, x, times, *rest: (told.append(times), forward(self, x, times, *rest))[1]
    )
    frames(model, ask(model, 1))
    assert [times[0].tolist() for times in told] == [[0] * 4 + [t] * 4 for t in (999, 666, 332)]


def test_with_one_time_and_one_context_it_is_diffusers_own_unet():
    from diffusers import UNetSpatioTemporalConditionModel

    model = make_diffusion()
    plain = UNetSpatioTemporalConditionModel.from_config(model.unet.net.config).eval()
    plain.load_state_dict(model.unet.net.state_dict())
    sample, context = torch.randn(2, 5, 19, 8, 12), torch.randn(2, 3, 16)
    added, times = torch.rand(2, 3), torch.tensor([17, 400])
    with torch.no_grad():
        ours = model.unet(sample, times[:, None].expand(2, 5), context[:, None].expand(2, 5, 3, 16), added)
        theirs = plain(sample, times, context, added).sample
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("steps", [1, 4])
def test_few_steps_are_a_setting(model, monkeypatch, steps):
    calls = []
    predict = model.predict_v
    monkeypatch.setattr(model, "predict_v", lambda *given: (calls.append(1), predict(*given))[1])
    monkeypatch.setattr(model, "num_denoise_steps", steps)
    frames(model, ask(model, 1))
    assert len(calls) == steps


def test_siglip_may_look_instead_of_clip():
    siglip = {"model_type": "siglip_vision_model", **{key: value for key, value in CLIP.items() if key != "model_type"}}
    model = make_diffusion(image_encoder=siglip)
    assert type(model.context.encoder).__name__ == "SiglipVisionModel"
    assert frames(model, ask(model, 1)).shape == (1, 1, 4, 3, 32, 32)


def test_it_is_saved_and_paints_the_same_again(model, tmp_path):
    again = DiffusionWorldModel.from_pretrained(model.save_pretrained(tmp_path)).eval()
    assert again.config == model.config
    asked = ask(model, 1)
    assert torch.equal(frames(again, asked), frames(model, asked))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frame_size": (16, 22)}, "frame_size must be at least 16 px, its width .* multiples of 4 .* got 16 x 22"),
        ({"image_size": 8}, "image_size must be at least 16 px, got 8"),
        ({"memory_frames": 1}, "memory_frames must be at least 2"),
        ({"chunk_length": 0}, "chunk_length, context_queries, .* must be at least 1"),
        ({"num_denoise_steps": 0}, "num_denoise_steps must lie between 1 and 1000, got 0"),
        ({"consistency_steps": 1}, "consistency_steps must lie between 2 and 1000, got 1"),
        ({"eta": 1.5}, r"eta must lie in \[0, 1\]"),
        ({"precision": "half"}, "precision must be auto, float32 or bfloat16, got 'half'"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        DiffusionWorldModelConfig.for_cameras(ONE, **{**SMALL, **settings})


def test_cameras_are_needed(model):
    with pytest.raises(ValueError, match="cameras must give every camera"):
        DiffusionWorldModel(DiffusionWorldModelConfig(**SMALL))
    asked = ask(model, 1)
    del asked[memory_key("wrist")]
    with pytest.raises(ValueError, match=r"must be uint8 \[B, 4, 3, 32, 32\], got nothing"):
        model(asked)
    asked = ask(model, 1)
    asked["poses"] = asked["poses"][:, :3]
    with pytest.raises(ValueError, match=r"poses must be \[B, 4, 13\]"):
        model(asked)


def test_the_defaults_are_evacs():
    config = DiffusionWorldModelConfig.for_cameras({"agentview": {PULL: FRONT, PUSH: FRONT}})
    assert config.latent_size == (40, 64) and config.frames == 20 and config.instructions == (PULL, PUSH)
    assert UNET["cross_attention_dim"] != config.unet["cross_attention_dim"] == 1024
    assert VAE["scaling_factor"] != config.vae["scaling_factor"] == 0.18215


def test_cameras_by_name_alone_are_refused_with_what_they_must_be():
    with pytest.raises(ValueError, match=r"cameras must be \{name: \{instruction: camera\}\}.*got \('agentview',\)"):
        DiffusionWorldModelConfig.for_cameras(("agentview",))
