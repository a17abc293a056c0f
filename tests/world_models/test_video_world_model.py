from __future__ import annotations

import re
import warnings

import pytest
import torch
from small_models import FRONT, ONE, PULL, PUSH, SMALL, close, fresh_model, make_model, make_request

from worldenv_trl.keys import FRAMES
from worldenv_trl.language import instructions_of
from worldenv_trl.robot import look_at
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig

PAINTED = (FRAMES, "image")


@pytest.fixture(scope="module")
def model() -> VideoWorldModel:
    return make_model()


def test_a_call_writes_one_chunk_of_uint8_frames_and_keeps_its_inputs(model):
    td = make_request(model, 5)
    before = td.clone()
    out = model(td)
    assert out[PAINTED].shape == (5, 8, 3, 32, 32) and out[PAINTED].dtype == torch.uint8
    assert (out.exclude(FRAMES) == before).all()


def test_no_rows_give_no_frames(model):
    assert model(make_request(model, 2)[:0])[PAINTED].shape == (0, 8, 3, 32, 32)


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_row_does_not_depend_on_the_other_rows(model, deterministic):
    model.deterministic, model.num_denoise_steps = deterministic, 2
    together = model(make_request(model, 20))[PAINTED]
    alone = torch.cat([model(make_request(model, 20)[row : row + 1])[PAINTED] for row in (0, 7, 19)])
    model.deterministic = True
    assert close(together[[0, 7, 19]], alone)


def test_the_number_of_rows_a_call_takes_at_once_changes_nothing(model):
    other = make_model(rows_per_call=3)
    assert close(other(make_request(other, 8))[PAINTED], model(make_request(model, 8))[PAINTED])


def test_stochastic_frames_depend_on_the_row_seed_alone(model):
    td = make_request(model, 4)
    td["noise_seed"][:] = 7
    model.deterministic = False
    first = model(td.clone())[PAINTED]
    td["noise_seed"][:2] = 8
    second = model(td)[PAINTED]
    model.deterministic = True
    assert torch.equal(first[2:], second[2:])
    assert not torch.equal(first[:2], second[:2])


def test_the_deterministic_mode_ignores_seeds_and_needs_none(model):
    td = make_request(model, 3)
    first = model(td.clone())[PAINTED]
    assert torch.equal(first, model(td.exclude("noise_seed"))[PAINTED])


def test_without_seeds_noise_comes_from_torchs_generator(model):
    td = make_request(model, 2).exclude("noise_seed")
    model.deterministic = False
    drawn = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        drawn.append(model(td.clone())[PAINTED])
    model.deterministic = True
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])


def test_an_untrained_model_copies_the_last_frame():
    model = fresh_model()
    td = make_request(model, 2)
    td["memory", "frames", "image"][:] = td["memory", "frames", "image"][:, -1:]
    td["poses"][:] = td["memory", "poses"][:, -1:]
    last = td["memory", "frames", "image"][:, -1:].float()
    painted = model(td)[PAINTED].float()
    assert (painted - last).abs().mean() < 0.4 * (last - 127.5).abs().mean()


def test_a_hand_seen_edge_on_gives_finite_frames(model):
    td = make_request(model, 1)
    # The y axis along the camera's view: its projection is a point.
    axis = torch.nn.functional.normalize(torch.tensor([1.2, 0.0, 0.8]), dim=0)
    side = torch.tensor([0.0, 1.0, 0.0])
    td["poses"][..., :3] = 0.0
    td["poses"][..., 3:12] = torch.stack([side, axis, torch.linalg.cross(side, axis)], -1).flatten()
    conditions = model.conditions(td, instructions_of(td))
    assert conditions["views"][0].hand.isfinite().all()
    assert model.predict(None, torch.zeros(1), conditions).isfinite().all()


def test_memory_holds_the_first_frame_one_stride_back_and_the_last(model):
    indices = model.memory_indices(torch.tensor([0, 2, 8, 40]))
    assert indices.tolist() == [[0, 0, 0], [0, 0, 2], [0, 4, 8], [0, 36, 40]]


def test_a_saved_and_reloaded_model_paints_the_same_frames(model, tmp_path):
    model.save_pretrained(tmp_path)
    again = VideoWorldModel.from_pretrained(tmp_path).eval()
    assert again.config == model.config
    assert torch.equal(again(make_request(again, 3))[PAINTED], model(make_request(model, 3))[PAINTED])


def test_an_instruction_chooses_its_calibration():
    aside = look_at("agentview", (0.9, 0.6, 0.5), (0.0, 0.0, 0.1), 50.0)
    model = make_model({"agentview": {PULL: FRONT, PUSH: aside}})
    front, side = make_model(), make_model({"agentview": {PULL: aside, PUSH: aside}})
    both = model(make_request(model, 2, [PULL, PUSH]))[PAINTED]
    assert close(both[:1], front(make_request(front, 2))[PAINTED][:1])
    assert close(both[1:], side(make_request(side, 2))[PAINTED][1:])
    assert not close(both[1:], front(make_request(front, 2))[PAINTED][1:])


def test_an_instruction_that_was_not_trained_on_warns_once_and_works(model):
    with pytest.warns(UserWarning, match="the world model VideoWorldModel was never trained on the instruction 'bow'"):
        first = model(make_request(model, 2, "bow"))[PAINTED]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = model(make_request(model, 2, "bow"))[PAINTED]
    assert torch.equal(first, again)


def test_an_instruction_that_was_not_trained_on_gets_the_commonest_calibration():
    aside = look_at("agentview", (0.9, 0.6, 0.5), (0.0, 0.0, 0.1), 50.0)
    model = make_model({"agentview": {"first": aside, PULL: FRONT, PUSH: FRONT}})
    with pytest.warns(UserWarning, match="never trained"):
        unseen = model(make_request(model, 2, "bow"))[PAINTED]
    assert torch.equal(unseen, model(make_request(model, 2, PULL))[PAINTED])
    assert not torch.equal(unseen, model(make_request(model, 2, "first"))[PAINTED])


def test_the_model_knows_what_it_was_trained_on(model):
    assert model.instructions == (PULL, PUSH) and model.cameras == ("agentview",)


def test_a_patch_of_8_at_128_px_has_the_trunk_of_a_patch_of_4_at_64_px():
    seen, parameters = [], []
    for size, patch in ((64, 4), (128, 8)):
        model = fresh_model(image_size=size, patch=patch)
        trunk = model.denoiser.down, model.denoiser.shrink, model.denoiser.up, model.denoiser.grow
        parameters.append([tuple(each.shape) for part in trunk for each in part.parameters()])
        for part in (model.denoiser.down, model.denoiser.up):
            for level in part:
                level[0].register_forward_hook(lambda _, inputs, out: seen.append(tuple(out.shape)))
        assert model(make_request(model, 2))[PAINTED].shape == (2, 8, 3, size, size)
    assert parameters[0] == parameters[1]
    assert seen[:3] == seen[3:] == [(2, 16, 16, 16), (2, 32, 8, 8), (2, 16, 16, 16)]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": 40}, "image_size must be a multiple of 16"),
        ({"patch": 4}, "patch must leave at least 16 cells a side, got 4 px of 32 px images"),
        ({"num_denoise_steps": 9}, "between 1 and 4, got 9"),
        ({"memory_stride": 9}, "memory_stride must lie between 1 and chunk_length=8, got 9"),
        ({"blocks": (1,)}, "equally long"),
        ({"precision": "float8"}, "precision must be auto, float32 or bfloat16, got 'float8'"),
        ({"width": 12}, "must be a positive multiple of 8, got 12"),
        ({"unroll_prob": 2}, "unroll_prob must lie between 0 and 1, got 2"),
        ({"noise_prob": -0.5}, "noise_prob must lie between 0 and 1, got -0.5"),
        ({"moving_weight": -1.0}, "must not be negative, got 0.15 and -1.0"),
    ],
)
def test_an_impossible_setting_is_named(settings, message):
    with pytest.raises(ValueError, match=message):
        VideoWorldModelConfig.for_cameras(ONE, **{**SMALL, **settings})


@pytest.mark.parametrize("cameras", [{}, {"agentview": {}}, {"agentview": {PULL: FRONT}, "wrist": {PUSH: FRONT}}])
def test_a_model_without_a_camera_for_each_instruction_says_how_to_get_them(cameras):
    with pytest.raises(ValueError, match="for_cameras"):
        VideoWorldModel(VideoWorldModelConfig.for_cameras(cameras))


def test_frames_of_another_size_kind_or_camera_are_refused(model):
    td, frames = make_request(model, 2), ("memory", "frames", "image")
    expected = re.escape(f"{frames} must be uint8 [B, 3, 3, 32, 32], got ")
    for wrong, got in (
        (td[frames][..., :16, :16], "torch.uint8 (2, 3, 3, 16, 16)"),
        (td[frames].float(), "torch.float32 (2, 3, 3, 32, 32)"),
        (td[frames][:, :2], "torch.uint8 (2, 2, 3, 32, 32)"),
    ):
        with pytest.raises(ValueError, match=expected + re.escape(got)):
            model(td.clone().set(frames, wrong))
    with pytest.raises(ValueError, match=expected + "nothing"):
        model(td.exclude(frames))


def test_a_chunk_of_another_length_or_arm_is_refused(model):
    with pytest.raises(ValueError, match=r"poses must be \[B, 8, 13\], got \(2, 4, 13\)"):
        model(make_request(model, 2, chunk=4))
    td = make_request(model, 2)
    with pytest.raises(ValueError, match=r"padded_actions must be \[B, 8, 14\], got \(2, 8, 13\)"):
        model(td.set("padded_actions", td["padded_actions"][..., :13]))


def test_a_request_without_a_goal_is_refused(model):
    with pytest.raises(ValueError, match="holds no 'language_instruction'"):
        model(make_request(model, 2).exclude("language_instruction"))


@pytest.mark.parametrize(("size", "cameras", "rows"), [(64, 1, 16), (64, 2, 16), (128, 1, 8), (128, 2, 4), (512, 2, 1)])
def test_fewer_rows_of_larger_images_pass_at_once(size, cameras, rows):
    some = {str(index): {"open the drawer": {}} for index in range(cameras)}
    assert VideoWorldModelConfig(cameras=some, image_size=size, patch=size // 16).rows_at_once() == rows
    assert VideoWorldModelConfig(cameras=some, image_size=size, rows_per_call=5).rows_at_once() == 5


def test_no_rows_at_once_are_refused():
    with pytest.raises(ValueError, match="rows_per_call must be at least 1, got 0"):
        VideoWorldModelConfig(rows_per_call=0)
